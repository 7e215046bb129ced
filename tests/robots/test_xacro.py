import numpy as np
import pytest

from experiments.simulation.roboarm.models import ArmModel
from experiments.simulation.roboarm.robots import Robot
from prism_jax.io.errors import InputError
from prism_jax.robots.xacro import plain_urdf
from tests.experiments.simulation.roboarm import conftest as boxes

HEAD = '<?xml version="1.0"?><robot name="r" xmlns:xacro="http://wiki.ros.org/xacro">'


def written(tmp_path, body, name="r.xacro"):
    path = tmp_path / name
    path.write_text(f"{HEAD}{body}</robot>")
    return path


def expanded(tmp_path, body):
    return plain_urdf(written(tmp_path, body))


def test_expressions_are_arithmetic_of_properties(tmp_path):
    robot = expanded(
        tmp_path,
        '<xacro:property name="half" value="${pi / 2}"/>'
        '<xacro:property name="deg" value="0.5"/>'
        '<a whole="${-half * 2 + 1}" mixed="0 ${radians(180) - pi} ${deg}"/>',
    )
    whole = float(robot[0].get("whole"))
    assert whole == pytest.approx(1 - np.pi)
    assert robot[0].get("mixed") == "0 0.0 0.5"


def test_macros_have_parameters_defaults_and_names_of_their_own(tmp_path):
    robot = expanded(
        tmp_path,
        '<xacro:property name="p" value="outer"/>'
        '<xacro:macro name="part" params="p size:=3 note:=\'a b\'">'
        '<link name="${p}_link" size="${size}" note="${note}"/></xacro:macro>'
        '<xacro:part p="left"/><xacro:part p="" size="${4 - 2}"/><link name="${p}"/>',
    )
    assert [dict(link.attrib) for link in robot] == [
        {"name": "left_link", "size": "3.0", "note": "a b"},
        {"name": "_link", "size": "2.0", "note": "a b"},
        {"name": "outer"},
    ]


def test_conditions_and_arguments_take_their_defaults(tmp_path):
    robot = expanded(
        tmp_path,
        '<xacro:arg name="on" default="true"/><xacro:arg name="file" default=""/>'
        '<xacro:if value="$(arg on)"><yes/></xacro:if>'
        '<xacro:unless value="$(arg on)"><no/></xacro:unless>'
        '<xacro:property name="f" value="$(arg file)"/>'
        '<xacro:if value="${f != \'\'}"><xacro:include filename="${f}"/></xacro:if>',
    )
    assert [element.tag for element in robot] == ["yes"]


def test_files_are_included_from_packages_above(tmp_path):
    (tmp_path / "other" / "urdf").mkdir(parents=True)
    own = tmp_path / "arm" / "urdf"
    own.mkdir(parents=True)
    written(tmp_path / "other" / "urdf", '<material name="red"/>', "m.xacro")
    written(own, '<xacro:macro name="link" params=""><l/></xacro:macro>', "l.xacro")
    path = written(
        own,
        '<xacro:include filename="$(find other)/urdf/m.xacro"/>'
        '<xacro:include filename="$(find arm_support)/urdf/l.xacro"/><xacro:link/>',
    )
    robot = plain_urdf(path)
    assert [element.tag for element in robot] == ["material", "l"]


def test_a_robot_is_the_same_from_xacro(tmp_path, model):
    path = tmp_path / "boxes.xacro"
    shoulder = f'xyz="0 0 {boxes.SHOULDER - 0.1}"'
    text = boxes.URDF.replace("<robot ", f"{HEAD.partition('?>')[2][:6]} ")
    assert shoulder in text
    text = text.replace(shoulder, f'xyz="0 0 ${{{boxes.SHOULDER} - 1 / 10}}"')
    path.write_text(text)
    positions = np.array([[0.4, 0.9, -1.2]])
    np.testing.assert_allclose(
        Robot(ArmModel("boxes", "test", str(path))).link_poses(positions),
        Robot(model).link_poses(positions),
        atol=1e-12,
    )


MACRO = '<xacro:macro name="m" params="{}">{}</xacro:macro><xacro:m/>'

DOUBLING = '<xacro:macro name="m0" params=""/>' + "".join(
    f'<xacro:macro name="m{i + 1}" params=""><xacro:m{i}/><xacro:m{i}/></xacro:macro>'
    for i in range(30)
)
DOUBLING += "<xacro:m30/>"
GROWING = '<xacro:property name="p" value="ab"/>'
GROWING += '<xacro:property name="p" value="${p}${p}"/>' * 40


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ('<xacro:call macro="a"/>', "xacro:call is not supported"),
        ('<xacro:include filename="gone.xacro"/>', "no such included file 'gone.xacro"),
        ('<a b="${unknown}"/>', "invalid expression 'unknown'"),
        ("<a b=\"${__import__('os')}\"/>", "invalid expression"),
        ('<a b="$(env HOME)"/>', r"asks for \$\(env HOME\)"),
        (MACRO.format("p", ""), "call of m without p"),
        (MACRO.format("*b", ""), "macro with block parameters"),
        (MACRO.format("", "<xacro:m/>"), "nested too deeply"),
        (DOUBLING, "letters exceed the limit"),
        (GROWING, "letters exceed the limit"),
        (f'<a b="${{{"1+" * 300}1}}"/>', "over 500 letters"),
        (f'<a b="${{{"(" * 240}1{")" * 240}}}"/>', "invalid expression"),
        (f"<a>{'<b>' * 2000}{'</b>' * 2000}</a>", "recursion"),
        (f'<xacro:include filename="{"f" * 300}"/>', "no such included file"),
        ("<a>", "not XML"),
    ],
)
def test_what_is_not_understood_is_named(tmp_path, body, message):
    with pytest.raises(InputError, match=message):
        plain_urdf(written(tmp_path, body))
