"""Names of what actuators hold: each is an attribute of MuJoCo's schema, and the entries that this changes."""

import re
from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from diransac.errors import ModelError
from diransac.model.mjcf import calibrated_text
from diransac.model.robots.fields import ACTUATORS, OF_ALL_ACTUATORS, REPLACED, kind_of_actuator

mujoco = pytest.importorskip("mujoco", reason="ACTUATORS NOT CHECKED: mujoco is missing")
if not hasattr(mujoco.mjtGain, "mjGAIN_PID"):
    pytest.skip("ACTUATORS NOT CHECKED: those of MuJoCo 4 are missing", allow_module_level=True)

FILE = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="base"><site name="world"/><geom size="0.01"/>
    <body name="link"><joint name="j" {joint} armature="0.005" damping="0.05"/><site name="s"/>
      <inertial pos="0 0 -0.15" mass="0.5" diaginertia="0.002 0.002 0.001"/></body></body>
</worldbody><actuator>{actuator}</actuator></mujoco>"""

MUSCLE = {"range": "0.5 1.05", "force": "100", "scale": "200", "lmin": "0.5", "lmax": "1.6", "vmax": "1.5"}
ATTRIBUTES = {
    "general": {},
    "motor": {},
    "position": {"kp": "10", "kv": "1", "timeconst": "0.1"},
    "velocity": {"kv": "2"},
    "intvelocity": {"kp": "10", "kv": "1", "actrange": "-1 1"},
    "orientation": {"kp": "10", "kv": "1"},
    "damper": {"kv": "1", "ctrlrange": "0 1"},
    "cylinder": {"timeconst": "0.1", "area": "0.5", "bias": "1 2 3"},
    "adhesion": {"gain": "3", "ctrlrange": "0 1"},
    "muscle": {"timeconst": "0.01 0.04", "tausmooth": "0.1", **MUSCLE, "fpmax": "1.3", "fvmax": "1.2"},
    "pid": {"kp": "12", "kv": "0.5", "ki": "3", "imax": "0.4", "slewmax": "2", "input": "pos vel ff"},
    "dcmotor": {
        "motorconst": "0.05",
        "resistance": "2",
        "inductance": "0 0.001",
        "thermal": "3 5 0 0.004 25 22",
        "saturation": "2 0 7",
        "cogging": "0.1 6 0.3",
        "lugre": "100 1 0.2 0.3 0.1",
        "controller": "10 2 0.5 3 0.4 24",
        "input": "pos vel",
    },
}
"""All attributes that a kind of actuator has for itself, with what they need."""
OTHERS = {"dampratio", "nominal", "diameter", "inheritrange", "input"} | {"posrange", "velrange", "ffrange", "actrange"}
"""Attributes of single kinds that are ranges and signatures, or of which MuJoCo makes others."""


def text(kind, attributes):
    """File with one actuator."""
    target = {"adhesion": 'body="base"', "orientation": 'joint="j"'}.get(kind, 'joint="j"')
    own = " ".join(f'{key}="{x}"' for key, x in attributes.items())
    length = ' lengthrange="-1 1"' if kind == "muscle" else ""
    joint = 'type="ball"' if kind == "orientation" else 'axis="0 1 0"'
    return FILE.format(joint=joint, actuator=f'<{kind} name="a" {target}{length} {own}/>')


def compiled(kind, attributes):
    return mujoco.MjModel.from_xml_string(text(kind, attributes))


def changed(one, other):
    """Entries of actuators that differ, without what MuJoCo derives, as value by place."""
    arrays = [x for x in dir(one) if x.startswith("actuator_") and x != "actuator_acc0"]
    found = {}
    for name in arrays:
        own, theirs = getattr(one, name), getattr(other, name)
        if isinstance(own, np.ndarray):
            found |= {(name, tuple(at.tolist())): theirs[tuple(at)] for at in np.argwhere(own != theirs)}
    return found


def numbers():
    """Kind, attribute, and index of each number of the table."""
    for kind, fields in ACTUATORS.items():
        for name, field in fields.items():
            yield from ((kind, name, k) for k in range(len(field.numbers)))


@pytest.mark.parametrize(("kind", "name", "k"), list(numbers()))
def test_a_name_is_the_entries_that_its_attribute_changes(kind, name, k):
    number, nominal = ACTUATORS[kind][name].numbers[k], ATTRIBUTES[kind]
    values = [float(x) for x in nominal[name].split()]
    before, after = compiled(kind, nominal), []
    for factor in (1.25, 1.5):
        new = [x * factor if i == k else x for i, x in enumerate(values)]
        after.append(changed(before, compiled(kind, nominal | {name: " ".join(map(repr, new))})))
    if number.instead:
        assert after == [{}, {}]  # it is 0, and another number has its effect
        return
    places = {(array, (0,) if getattr(before, array).ndim == 1 else (0, c)): f for array, c, f in number.places}
    for factor, entries in zip((1.25, 1.5), after, strict=True):
        expected = {place: f * values[k] * factor for place, f in places.items()}
        assert entries == pytest.approx(expected, rel=1e-12)


def schema():
    """Attributes of each kind of actuator by MuJoCo's own list."""
    lines = mujoco.mj_printSchema(False, False).splitlines()
    first = next(k for k, line in enumerate(lines) if re.match(r" {3}actuator ", line))
    found, kind = {}, ""
    for line in lines[first + 1 :]:
        if re.match(r" {3}\w", line):
            break
        if start := re.match(r" {6}(\w+) \(.\)\s+(.*)", line):
            kind, line = start[1], start[2]
            found[kind] = set()
        elif re.match(r" {6,9}\w", line):
            kind = ""  # of an element in it
        if kind:
            found[kind] |= set(line.split())
    return found


def test_all_attributes_of_mujocos_actuators_have_a_name_or_a_reason():
    """A new kind or attribute of MuJoCo fails here."""
    found = schema()
    assert set(found) - {"plugin"} == set(ACTUATORS)
    common = found["motor"] | {"body", "class", "actdim", "actearly", "actlimited", "dyntype", "gaintype", "biastype"}
    raw = {"dynprm", "gainprm", "biasprm"}
    for kind in ACTUATORS:
        assert found[kind] - common - raw - OTHERS == set(ACTUATORS[kind]), kind
    assert set(OF_ALL_ACTUATORS) < common
    assert set(REPLACED) < OTHERS


@pytest.mark.parametrize("kind", list(ACTUATORS))
def test_the_kind_is_read_from_the_compiled_model(kind):
    expected = "motor" if kind == "general" else kind  # which MuJoCo makes of it
    assert kind_of_actuator(compiled(kind, ATTRIBUTES[kind]), 0) == expected


@pytest.mark.parametrize(("kind", "name"), list(dict.fromkeys((kind, name) for kind, name, _ in numbers())))
def test_calibrated_files_have_them_as_attributes_of_the_same_kind(tmp_path: Path, kind, name):
    path = tmp_path / "a.xml"
    path.write_text(text(kind, ATTRIBUTES[kind]))
    model = dr.models.mujoco(path, unknown=[f"actuator/a.{name}"])
    nominal = [x.value for x in model.parameters.values()]
    present = [x for x in ACTUATORS[kind][name].numbers if not x.instead]
    written = [
        float(x)
        for x, n in zip(ATTRIBUTES[kind][name].split(), ACTUATORS[kind][name].numbers, strict=True)
        if not n.instead
    ]
    assert nominal == pytest.approx(written)
    assert len(nominal) == len(present)
    values = {n: 1.25 * x for n, x in zip(model.parameters, nominal, strict=True)}
    new, left_out = calibrated_text(path, model, values, np.eye(len(values)))
    assert f'<{kind} name="a"' in new
    assert left_out == ()
    path.write_text(new)
    again = dr.models.mujoco(path, unknown=[f"actuator/a.{name}"])
    assert [x.value for x in again.parameters.values()] == pytest.approx(list(values.values()))


@pytest.mark.parametrize(
    ("kind", "attributes", "name", "field"),
    [
        ("dcmotor", {"nominal": "24 5 100", "inductance": "0.001 0"}, "resistance", "motorconst"),
        ("dcmotor", {"motorconst": "0.05", "resistance": "2", "saturation": "0 5 0"}, "motorconst", "resistance"),
        ("position", {"kp": "30", "dampratio": "1"}, "kp", "kv"),
        ("cylinder", {"diameter": "0.1", "timeconst": "0.2"}, "area", "timeconst"),
    ],
)
def test_what_the_compiler_makes_of_other_attributes_stays_as_it_was(tmp_path: Path, kind, attributes, name, field):
    path = tmp_path / "a.xml"
    path.write_text(text(kind, attributes))
    model = dr.models.mujoco(path, unknown=[f"actuator/a.{name}"])
    expected = compiled(kind, attributes)
    ((mask, parameter),) = model.parameters.items()
    new, _ = calibrated_text(path, model, {mask: 2.0 * parameter.value}, np.eye(1))
    differing = changed(expected, mujoco.MjModel.from_xml_string(new))
    assert differing == pytest.approx(
        {(x.array, x.index): 2.0 * parameter.value * x.factor for x in model.unknowns[0].places}
    )
    assert f'<{kind} name="a"' in new
    path.write_text(new)
    assert dr.models.mujoco(path, unknown=[f"actuator/a.{field}"]).parameters[f"actuator/a.{field}"].value > 0.0


@pytest.mark.parametrize(
    ("kind", "attributes", "name", "said"),
    [
        ("position", {"kp": "30", "dampratio": "1"}, "dampratio", "of the kind position; give kv, which MuJoCo's"),
        ("motor", {}, "kp", "of the kind motor; choose from gear, armature, damping, lengthrange, gainprm"),
        ("pid", {"kp": "30"}, "ki", "the file has 0 there"),
        ("pid", {"kp": "30"}, "lugre", "of the kind pid; choose from kp, kv, gear"),
        ("position", {"kp": "30"}, "timeconst", "the file has 0 there"),
        ("dcmotor", {"nominal": "24 5 100"}, "nominal", "give motorconst and resistance"),
        ("dcmotor", {"nominal": "24 5 100"}, "lugre[2]", "the file has 0 there"),
        ("dcmotor", {"nominal": "24 5 100"}, "lugre", "the file has 0 there"),
        ("dcmotor", {"nominal": "24 5 100"}, "lugre[5]", "has the index 5, but lugre has 5 entries"),
        ("dcmotor", ATTRIBUTES["dcmotor"], "thermal[2]", r"give thermal\[0\] and thermal\[1\]"),
    ],
)
def test_a_name_without_an_entry_is_refused_with_those_that_have_one(tmp_path: Path, kind, attributes, name, said):
    path = tmp_path / "a.xml"
    path.write_text(text(kind, attributes))
    with pytest.raises(ModelError, match=said):
        dr.models.mujoco(path, unknown=[f"actuator/a.{name}"])


def test_a_pattern_names_those_actuators_that_have_the_field(tmp_path: Path):
    path = tmp_path / "a.xml"
    both = '<position name="a" joint="j" kp="30"/><pid name="b" joint="j" kp="12"/><motor name="c" joint="j"/>'
    path.write_text(FILE.format(joint='axis="0 1 0"', actuator=both))
    model = dr.models.mujoco(path, unknown=["each:actuator/*.kp", "actuator/*.armature"])
    assert {n: x.value for n, x in model.parameters.items()} == {
        "actuator/a.kp": 30.0,
        "actuator/b.kp": 12.0,
        "actuator/*.armature": 0.0,
    }
    values = {"actuator/a.kp": 31.0, "actuator/b.kp": 13.0, "actuator/*.armature": 0.002}
    new, _ = calibrated_text(path, model, values, np.eye(3))
    assert '<position name="a" joint="j" kp="31.0" armature="0.002"/>' in new
    assert '<pid name="b" joint="j" kp="13.0" armature="0.002"/>' in new
