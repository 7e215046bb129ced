"""Robots written with xacro, the macro language of ROS, as plain URDF.

The part of http://wiki.ros.org/xacro that descriptions of arms are written in:
properties, arguments with defaults, includes, conditions, macros without blocks, and
``${}`` of numbers, strings, names, arithmetic and comparisons. Expressions are read,
never executed, and nothing is read but the files that are included. All else raises
InputError.
"""

import ast
import math
import operator
import os
import pathlib
import re
import shlex
import xml.etree.ElementTree as ElementTree
from typing import Any

from prism_jax.io.errors import InputError
from prism_jax.io.files import check_count, parsing, read_bytes

_REMEDY = "convert the robot to plain URDF"
_OPERATORS: dict[type, Any] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
_FUNCTIONS = {"radians": math.radians, "sin": math.sin, "cos": math.cos}
_DEPTH = 40  # of macros and includes within each other
_MAX_LETTERS = 10_000_000  # of a file, and of what a robot is written out to
_ELEMENT = 1000  # letters that an element counts for


def plain_urdf(path: pathlib.Path) -> ElementTree.Element:
    """A xacro file's robot as URDF, all arguments at their defaults."""
    expansion, source = _Expansion(path), robot_xml(path)
    robot = ElementTree.Element("robot", source.attrib)
    try:
        robot.extend(expansion.children(source, {"pi": math.pi}))
        return robot
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(expansion.path, str(error), _REMEDY) from None


def robot_xml(path: pathlib.Path) -> ElementTree.Element:
    """A file's elements. One that is large or declares XML entities, of which a few
    lines can stand for gigabytes, raises InputError, as one that is no XML."""
    data = read_bytes(path)
    if b"<!DOCTYPE" in data or b"\0" in data:  # which UTF-16 is full of
        raise InputError(path, "uses XML entities", "write it without, in UTF-8")
    with parsing(path, "XML of a robot", "fix it, or use another one", Exception):
        if len(data) > _MAX_LETTERS:
            raise ValueError(f"over {_MAX_LETTERS:,} bytes")
        return ElementTree.fromstring(data)


def named_file(name: str, beside: pathlib.Path) -> pathlib.Path | None:
    """Where a name in a robot's file leads: beside that file, or in the package that it
    names, which is looked for in the folders above it; None if nowhere. A scheme other
    than package:// and file:// raises InputError."""
    scheme, found, rest = name.partition("://")
    if found and scheme not in ("package", "file"):
        fault = f"{scheme}:// is not supported"
        raise InputError(beside, fault, "use package:// or a path")
    places = [beside.parent / (rest if found else name)]
    if scheme == "package":
        places = [folder / rest for folder in beside.parents]
        places += [folder / rest.partition("/")[2] for folder in beside.parents]
    # Path.is_file raises OSError for a name that is too long.
    return next((place for place in places if os.path.isfile(place)), None)


class _Expansion:
    """One robot as it is written out; ValueError for a fault in the file at `path`."""

    def __init__(self, path: pathlib.Path):
        self.path, self._depth, self._letters = path, 0, 0
        self._arguments: dict[str, str] = {}
        self._macros: dict[str, ElementTree.Element] = {}

    def children(
        self, element: ElementTree.Element, names: dict[str, Any]
    ) -> list[ElementTree.Element]:
        """The elements below one, as they are written out."""
        written = []
        for child in element:
            self._count(_ELEMENT)
            namespace, _, tag = str(child.tag).rpartition("}")
            if namespace.endswith("/xacro"):
                written += self._own(tag, child, names)
                continue
            if not isinstance(child.tag, str):  # a comment
                continue
            copy = ElementTree.Element(
                child.tag, {k: self._text(v, names) for k, v in child.attrib.items()}
            )
            copy.text = child.text and self._text(child.text, names)
            copy.extend(self.children(child, names))
            written.append(copy)
        return written

    def _own(
        self, tag: str, element: ElementTree.Element, names: dict[str, Any]
    ) -> list[ElementTree.Element]:
        """What an element of xacro's own comes to; definitions come to nothing."""
        given = element.attrib
        try:
            if tag == "property":
                names[given["name"]] = self._value(given["value"], names)
            elif tag == "arg":
                self._arguments.setdefault(given["name"], given["default"])
            elif tag == "macro":
                self._macros[given["name"]] = element
            elif tag == "include":
                return self._included(self._text(given["filename"], names), names)
            elif tag in ("if", "unless"):
                holds = self._value(given["value"], names)
                if (holds in (True, "true", "True", 1)) == (tag == "if"):
                    return self.children(element, names)
            elif tag in self._macros:
                return self._called(self._macros[tag], given, names)
            else:
                raise ValueError(f"xacro:{tag} is not supported")
        except KeyError as error:
            raise ValueError(f"xacro:{tag} without {error.args[0]}") from None
        return []

    def _included(self, name: str, names: dict[str, Any]) -> list[ElementTree.Element]:
        place = named_file(name, self.path)
        if place is None:
            raise ValueError(f"no such included file {name!r}")
        outer, self.path = self.path, place
        self._count(os.path.getsize(place))
        written = self._deeper(robot_xml(place), names)
        self.path = outer
        return written

    def _called(
        self, macro: ElementTree.Element, given: dict[str, str], names: dict[str, Any]
    ) -> list[ElementTree.Element]:
        own, parameters = dict(names), macro.attrib.get("params", "")
        self._count(10 * len(own) + len(parameters))
        for parameter in shlex.split(parameters):
            name, has_default, default = parameter.partition("=")
            name = name.rstrip(":")
            if name.startswith("*"):
                raise ValueError("macro with block parameters")
            if name not in given and not has_default:
                raise ValueError(f"call of {macro.attrib['name']} without {name}")
            own[name] = self._value(given.get(name, default), names)
        return self._deeper(macro, own)

    def _deeper(
        self, element: ElementTree.Element, names: dict[str, Any]
    ) -> list[ElementTree.Element]:
        if self._depth == _DEPTH:
            raise ValueError("macros are nested too deeply")
        self._depth += 1
        written = self.children(element, names)
        self._depth -= 1
        return written

    def _value(self, text: str, names: dict[str, Any]) -> Any:
        """What a text stands for: an expression's own value if it is nothing else."""
        whole = re.fullmatch(r"\$\{([^{}]*)\}", text.strip())
        return self._evaluated(whole[1], names) if whole else self._text(text, names)

    def _text(self, text: str, names: dict[str, Any]) -> str:
        def replaced(match: re.Match) -> str:
            if match["expression"] is not None:
                value = str(self._evaluated(match["expression"], names))
                self._count(len(value))
                return value
            command, _, name = match["command"].strip().partition(" ")
            if command == "find":
                return f"package://{name.strip()}"
            if command == "arg" and name in self._arguments:
                return self._arguments[name]
            raise ValueError(f"asks for {match[0]}")

        pattern = r"\$\{(?P<expression>[^{}]*)\}|\$\((?P<command>[^()]*)\)"
        self._count(len(text))
        return re.sub(pattern, replaced, text)

    def _count(self, letters: int) -> None:
        """ValueError once there are too many: a few macros can stand for gigabytes."""
        self._letters += letters
        check_count(self._letters, _MAX_LETTERS, "letters")

    def _evaluated(self, text: str, names: dict[str, Any]) -> Any:
        if len(text) > 500:
            raise ValueError("an expression is over 500 letters long")
        try:
            return _result(ast.parse(text.strip(), mode="eval").body, names)
        except (SyntaxError, ValueError, TypeError, KeyError, ArithmeticError):
            raise ValueError(f"invalid expression {text!r}") from None


def _result(node: ast.expr, names: dict[str, Any]) -> Any:
    """The value of an expression; ValueError for what is not allowed in one."""
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float | str):
        return node.value
    if isinstance(node, ast.Name):
        value = names[node.id]
        try:
            return float(value)
        except ValueError:
            return value
    if isinstance(node, ast.BinOp):
        left, right = _result(node.left, names), _result(node.right, names)
        if isinstance(left, str) or isinstance(right, str):
            raise ValueError("arithmetic of text")
        return _OPERATORS[type(node.op)](left, right)
    if isinstance(node, ast.UnaryOp):
        return _OPERATORS[type(node.op)](_result(node.operand, names))
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        left, right = _result(node.left, names), _result(node.comparators[0], names)
        return _OPERATORS[type(node.ops[0])](left, right)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        return _FUNCTIONS[node.func.id](*(_result(a, names) for a in node.args))
    raise ValueError("not an expression of xacro")
