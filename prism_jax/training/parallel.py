"""Data parallel training: the batch over all devices of all processes, the state on
each of them."""

from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from prism_jax.io.errors import InputError

Tree = TypeVar("Tree")

DATA = "data"
"""The mesh's only axis, over which the examples of a batch lie."""


def data_mesh() -> Mesh:
    """All devices of all processes in a row."""
    kinds = (AxisType.Auto,)
    return jax.make_mesh((jax.device_count(),), (DATA,), axis_types=kinds)


def check_batch(batch_size: int) -> None:
    """Raises InputError unless the batch is shared evenly by the devices."""
    count = jax.device_count()
    if batch_size % count:
        fault = f"{batch_size} examples cannot be shared evenly by {count} devices"
        remedy = "choose a multiple, or show JAX fewer devices"
        raise InputError("batch_size", fault, remedy)


def replicate(tree: Tree, mesh: Mesh) -> Tree:
    """The same values on every device; host arrays or replicated ones go in."""
    return jax.device_put(jax.device_get(tree), NamedSharding(mesh, PartitionSpec()))


def share(batch: Tree, mesh: Mesh) -> Tree:
    """One batch of all processes' own examples, along the data axis."""
    sharding = NamedSharding(mesh, PartitionSpec(DATA))

    def place(rows: np.ndarray) -> jax.Array:
        return jax.make_array_from_process_local_data(sharding, np.asarray(rows))

    return jax.tree.map(place, batch)


def shard() -> tuple[int, int]:
    """This process's number, and how many there are: what it reads of the data."""
    return jax.process_index(), jax.process_count()


def is_first() -> bool:
    """Whether this process writes what all of them know."""
    return jax.process_index() == 0


def as_the_first(found: bool) -> bool:
    """What the first process found, in every process, when all have come here."""
    if jax.process_count() == 1:
        return found
    return bool(multihost_utils.broadcast_one_to_all(np.array(found)))


def wait_for_all(what: str) -> None:
    """Returns when every process has come here."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(what)


def gather(rows: Any) -> np.ndarray:
    """An array that lies along the data axis, whole, in every process."""
    if jax.process_count() == 1:
        return np.asarray(rows)
    return np.asarray(multihost_utils.process_allgather(rows, tiled=True))
