"""Recordings written by rosbags, which we did not write: bags, .db3 and MCAP."""

import contextlib
import sqlite3

import numpy as np
import pytest

rosbag1 = pytest.importorskip("rosbags.rosbag1")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")

ROS1 = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
ROS2 = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
CLOUD, IMAGE = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image"
INFO, JOINTS = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/JointState"
TEXT = "std_msgs/msg/String"
SECOND = 1_000_000_000


def _header(store, time, frame_id="lidar"):
    stamp = store.types["builtin_interfaces/msg/Time"](time // SECOND, time % SECOND)
    seq = {"seq": 0} if store is ROS1 else {}
    return store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id, **seq)


def cloud(
    points, time, store=ROS2, height=1, big=False, gap=4, tail=0, frame_id="lidar"
):
    """A PointCloud2 with an intensity, each point's row, before x, y, z and padding."""
    scalar = points.dtype.newbyteorder(">" if big else "<")
    size, width = scalar.itemsize, len(points) // height
    step = gap + 3 * size + tail
    rows = np.full((len(points), step), 7, np.uint8)
    counted = np.arange(len(points), dtype=">f4" if big else "<f4")
    rows[:, :4] = counted.view(np.uint8).reshape(-1, 4)
    ordered = np.ascontiguousarray(points.astype(scalar)).view(np.uint8)
    rows[:, gap : gap + 3 * size] = ordered.reshape(len(points), 3 * size)
    kind = 8 if size == 8 else 7
    field = store.types["sensor_msgs/msg/PointField"]
    places = [(axis, gap + i * size, kind) for i, axis in enumerate("xyz")]
    fields = [field(*place, 1) for place in [("intensity", 0, 7), *places]]
    layout = {"is_bigendian": big, "point_step": step, "row_step": step * width}
    sizes = {"height": height, "width": width, "fields": fields, "is_dense": False}
    header = _header(store, time, frame_id)
    return store.types[CLOUD](header=header, data=rows.ravel(), **sizes, **layout)


def image(pixels, time, store=ROS2, encoding="16UC1", padding=0):
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    layout = {"encoding": encoding, "is_bigendian": 0, "step": rows.shape[1]}
    height, width = pixels.shape
    sizes = {"header": _header(store, time), "height": height, "width": width}
    return store.types[IMAGE](**sizes, **layout, data=rows.ravel())


def info(width, height, focal, time=0, store=ROS2, distortion=0.0, rectified=0.0):
    """A CameraInfo, whose projection has the focal length `rectified`."""
    k = np.array([focal, 0, (width - 1) / 2, 0, focal, (height - 1) / 2, 0, 0, 1.0])
    values = {"d": np.full(5, distortion), "k": k, "r": np.eye(3).ravel()}
    values["p"] = np.zeros(12)
    if rectified:
        values["p"][[0, 2, 5, 6, 10]] = rectified, 1.0, rectified, 2.0, 1.0
    if store is ROS1:
        values = {name.upper(): value for name, value in values.items()}
    values |= {"distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0}
    values |= {"header": _header(store, time), "height": height, "width": width}
    region = store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    return store.types[INFO](roi=region, **values)


def joints(positions, time, store=ROS2):
    """A JointState of positions by name."""
    none = np.zeros(0)
    values = np.array(list(positions.values()), np.float64)
    header = _header(store, time)
    return store.types[JOINTS](header, list(positions), values, none, none)


def write_bag(path, messages, packed=None):
    """A ROS 1 bag of ``(topic, type, log time, message)``; `packed` is "bz2", "lz4"."""
    writer = rosbag1.Writer(path)
    if packed:
        writer.set_compression(rosbag1.Writer.CompressionFormat[packed.upper()])
    _fill(writer, messages, ROS1, ROS1.serialize_ros1)
    return path


def write_bag2(path, messages, plugin="SQLITE3"):
    """A ROS 2 bag's folder; gives the file in it."""
    storage = rosbag2.StoragePlugin[plugin]
    writer = rosbag2.Writer(path, version=8, storage_plugin=storage)
    _fill(writer, messages, ROS2, ROS2.serialize_cdr)
    (file,) = [p for p in path.iterdir() if p.suffix in (".db3", ".mcap")]
    return file


def _fill(writer, messages, store, serialize):
    known = {}
    with writer:
        for topic, kind, time, message in messages:
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(known[topic], time, bytes(serialize(message, kind)))


def pack_messages(path):
    """Packs each message of a .db3 by itself, as rosbag2 does, not all with a size."""
    zstandard = pytest.importorskip("zstandard")
    with contextlib.closing(sqlite3.connect(path)) as database:
        rows = database.execute("SELECT id, data FROM messages").fetchall()
        for number, data in rows:
            packer = zstandard.ZstdCompressor(write_content_size=number % 2 > 0)
            packed = packer.compress(data), number
            database.execute("UPDATE messages SET data = ? WHERE id = ?", packed)
        database.commit()
    return path


def pack_file(path):
    """Packs a whole file, as rosbag2 does; gives its folder."""
    zstandard = pytest.importorskip("zstandard")
    path.write_bytes(zstandard.ZstdCompressor().compress(path.read_bytes()))
    return path.rename(f"{path}.zstd").parent


def write_mcap(path, messages, packed="ZSTD", chunk=4096, **asked):
    """An MCAP file by the `mcap` package."""
    mcap = pytest.importorskip("mcap.writer")
    packing = {"compression": mcap.CompressionType[packed], "chunk_size": chunk}
    with open(path, "wb") as file:
        writer = mcap.Writer(file, use_chunking=chunk > 0, **packing, **asked)
        writer.start()
        channels = {}
        for topic, kind, time, message in messages:
            if topic not in channels:
                text, _ = ROS2.generate_msgdef(kind, ros_version=2)
                schema = writer.register_schema(kind, "ros2msg", text.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            data = bytes(ROS2.serialize_cdr(message, kind))
            writer.add_message(channels[topic], time, data, time)
        writer.finish()
    return path


WRITERS = {
    "bag": lambda folder, m: write_bag(folder / "r.bag", m),
    "bag-bz2": lambda folder, m: write_bag(folder / "r.bag", m, "bz2"),
    "bag-lz4": lambda folder, m: write_bag(folder / "r.bag", m, "lz4"),
    "bag-open": lambda folder, m: write_bag(folder / "r.bag.active", m),
    "db3": lambda folder, m: write_bag2(folder / "r", m),
    "db3-packed": lambda folder, m: pack_messages(write_bag2(folder / "r", m)),
    "db3-packed-whole": lambda folder, m: pack_file(write_bag2(folder / "r", m)),
    "db3-folder": lambda folder, m: write_bag2(folder / "r", m).parent,
    "rosbags-mcap": lambda folder, m: write_bag2(folder / "r", m, "MCAP"),
    "mcap-zstd": lambda folder, m: write_mcap(folder / "r.mcap", m),
    "mcap-lz4": lambda folder, m: write_mcap(folder / "r.mcap", m, "LZ4"),
    "mcap-plain": lambda folder, m: write_mcap(folder / "r.mcap", m, "NONE"),
    "mcap-schemas-once": lambda folder, m: write_mcap(
        folder / "r.mcap", m, repeat_schemas=False
    ),
    "mcap-unchunked": lambda folder, m: write_mcap(folder / "r.mcap", m, "NONE", 0),
}
"""Each takes a folder and messages, and gives the path to open."""


def store_of(writer):
    """The types of the messages that a writer takes."""
    return ROS1 if writer.startswith("bag") else ROS2
