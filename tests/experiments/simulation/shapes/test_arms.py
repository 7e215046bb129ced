import numpy as np

from experiments.simulation.shapes.arms import posed_chain


def chain(seed: int, links: int = 5):
    rng = np.random.default_rng(seed)
    lengths, radii = np.full(links, 0.4), np.full(links, 0.06)
    return posed_chain(rng, 0.3, lengths, radii, np.zeros(links)), lengths


def test_links_join_end_to_start_with_their_lengths():
    posed, lengths = chain(0)
    np.testing.assert_allclose(posed.hinges[1:], posed.ends[:-1], atol=1e-12)
    reach = np.linalg.norm(posed.ends - posed.starts, axis=1)
    np.testing.assert_allclose(reach, lengths, rtol=1e-12)


def test_frames_are_rotations_along_the_links():
    posed, lengths = chain(1)
    product = np.einsum("lij,lik->ljk", posed.frames, posed.frames)
    np.testing.assert_allclose(product, np.tile(np.eye(3), (5, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(posed.frames), 1, rtol=1e-12)
    along = (posed.ends - posed.starts) / lengths[:, None]
    np.testing.assert_allclose(along, posed.frames[:, :, 2], atol=1e-12)


def test_poses_stay_over_the_floor_and_clear_of_themselves():
    for seed in range(20):
        posed, _ = chain(seed)
        assert np.all(posed.ends[:, 2] > 2 * posed.radii)
        for i in range(2, 5):
            share = np.linspace(0, 1, 50)[:, None]
            first = posed.starts[i] + share * (posed.ends[i] - posed.starts[i])
            for j in range(i - 1):
                other = posed.starts[j] + share * (posed.ends[j] - posed.starts[j])
                gaps = np.linalg.norm(first[:, None] - other[None], axis=-1)
                assert gaps.min() > posed.radii[i] + posed.radii[j]


def test_postures_differ():
    tips = np.array([chain(seed)[0].ends[-1] for seed in range(10)])
    assert np.ptp(tips, axis=0).min() > 0.2
