"""Data parallel training: the batch over all devices, the state on each of them."""

from typing import TypeVar

import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from prism_jax.io.errors import InputError

Tree = TypeVar("Tree")

DATA = "data"  # the mesh's only axis, over which the examples of a batch lie


def data_mesh() -> Mesh:
    """All devices in a row."""
    return Mesh(jax.devices(), (DATA,))


def check_batch(batch_size: int) -> None:
    """Raises InputError unless the batch is shared evenly by the devices."""
    count = jax.device_count()
    if batch_size % count:
        fault = f"{batch_size} examples cannot be split evenly across {count} devices"
        remedy = "use a multiple of the number of devices, or fewer devices"
        raise InputError("batch_size", fault, remedy)


def replicate(tree: Tree) -> Tree:
    """The same values on every device; host arrays or replicated ones go in."""
    everywhere = NamedSharding(data_mesh(), PartitionSpec())
    return jax.device_put(jax.device_get(tree), everywhere)


def share(batch: Tree) -> Tree:
    """A batch along the data axis."""
    return jax.device_put(batch, NamedSharding(data_mesh(), PartitionSpec(DATA)))
