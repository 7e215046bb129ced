"""YAML as ROS and OpenCV write cameras."""

import re
from typing import Any

import yaml

from prism_jax.io.errors import InputError, StrPath
from prism_jax.io.files import read_bytes

MAX_BYTES = 2**16  # a camera takes one or two thousand


class _Loader(yaml.SafeLoader):
    """With OpenCV's matrices and numbers such as 1e-5; without aliases, by which a
    small file can stand for any amount."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases are not supported")
        return super().compose_node(parent, index)


_Loader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix",
    lambda loader, node: loader.construct_mapping(node, deep=True),
)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?\d+[eE][-+]?\d+$"),
    list("+-0123456789"),
)


def read_yaml(path: StrPath, remedy: str) -> dict[str, Any]:
    """The entries of a file's first document; InputError, with the remedy, where it
    has none, and as for `read_bytes`. Nothing in it is executed."""
    data = read_bytes(path)
    # OpenCV's first line is no YAML.
    text = re.sub(rb"\A%YAML:[^\n]*\n", b"", data)
    try:
        if len(data) > MAX_BYTES:
            raise ValueError("too large")
        content = next(yaml.load_all(text, _Loader), None)
    except (ValueError, RecursionError, yaml.YAMLError):
        raise InputError(path, "not YAML of a camera", remedy) from None
    if type(content) is not dict:
        raise InputError(path, "no entries", remedy)
    return {str(key): value for key, value in content.items()}
