"""How near rules come to the true heading of partial views, up to quarter turns.

    python -m experiments.headings

On validation shapes, whose sides lie along x and y, each turned by a random angle.
"""

import numpy as np
from absl import flags
from tqdm import tqdm

from experiments.shifts import validation_views
from prism_jax.cli.launch import launch
from prism_jax.observation.heading import NUM_ANGLES, footprint_angle

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_integer("limit", None, "So many views, evenly spaced.", lower_bound=1)


def main() -> None:
    """Prints the table."""
    rng = np.random.default_rng(0)
    rules = {
        "histograms of least entropy": footprint_angle,
        "smallest rectangle": smallest_rectangle,
    }
    errors: dict[str, list[float]] = {name: [] for name in rules}
    for view in tqdm(validation_views("shapes", FLAGS.limit), mininterval=2.0):
        angle = rng.uniform(0, np.pi / 2)
        cosine, sine = np.cos(angle), np.sin(angle)
        turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])
        for name, rule in rules.items():
            miss = float(rule(view.partial @ turn.T)) - angle
            miss = (miss + np.pi / 4) % (np.pi / 2) - np.pi / 4
            errors[name].append(abs(np.rad2deg(miss)))
    print("| rule | median error | within 2 degrees | within 5 | within 10 |")
    print("| --- | --- | --- | --- | --- |")
    for name, values in errors.items():
        error = np.array(values)
        shares = [f"{(error < most).mean():.0%}" for most in (2, 5, 10)]
        print(f"| {name} | {np.median(error):.2f} | {' | '.join(shares)} |")


def smallest_rectangle(points: np.ndarray) -> float:
    """The angle of the rectangle of least area around the footprint."""
    angles = np.arange(NUM_ANGLES) * (0.5 * np.pi / NUM_ANGLES)
    cosine, sine = np.cos(angles)[:, None], np.sin(angles)[:, None]
    x, y = points[:, 0], points[:, 1]
    areas = np.ptp(cosine * x + sine * y, axis=1) * np.ptp(
        cosine * y - sine * x, axis=1
    )
    return float(angles[areas.argmin()])


def run() -> None:
    """The entry point."""
    define_flags()
    launch("headings", main)


if __name__ == "__main__":
    run()
