"""Descriptions with every attribute of MuJoCo: forces and accelerations are MuJoCo's own, or an attribute is named."""

import copy
import re

import numpy as np
import pytest

from diransac.errors import ModelError

mujoco = pytest.importorskip("mujoco", reason="DESCRIPTIONS OF ROBOTS NOT COMPARED: mujoco is missing")

import described_trees  # noqa: E402  # needs mujoco

from diransac.model.robots.description import described, read_description  # noqa: E402
from diransac.model.robots.reference import check_forces  # noqa: E402

FAMILIES = ("body_", "jnt_", "dof_", "tendon_", "actuator_", "qpos")


@pytest.fixture(scope="module", autouse=True)
def quiet():
    """No warnings of MuJoCo about attributes that it will drop."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    yield
    mujoco.set_mju_user_warning(before)


@pytest.mark.skipif(mujoco.__version__ < "4", reason="ATTRIBUTES OF MUJOCO 4 NOT DRAWN: an older one is installed")
@pytest.mark.parametrize("first", range(0, 100, 10))
def test_forces_and_accelerations_are_those_of_mujoco_or_an_attribute_is_named(tmp_path, first):
    outcomes = {seed: described_trees.outcome(seed, tmp_path) for seed in range(first, first + 10)}
    wrong = {seed: x for seed, x in outcomes.items() if x[0] == "wrong" or x[0].startswith("unnamed")}
    assert not wrong
    assert sum(x[0] == "equal" for x in outcomes.values()) >= 3


@pytest.mark.skipif(mujoco.__version__ < "4", reason="ATTRIBUTES OF MUJOCO 4 NOT DRAWN: an older one is installed")
def test_every_attribute_of_the_schema_is_drawn_or_left_out_with_a_reason():
    for element, attributes in described_trees.schema().items():
        if element in described_trees.VALUES:
            elsewhere = set(described_trees.ELSEWHERE.get(element, "").split())
            drawn = set(described_trees.VALUES[element])
            assert not attributes - drawn - elsewhere - described_trees.NAMES, element
            assert not (drawn | elsewhere) - attributes, element


TREE = """<mujoco><worldbody>
  <body><joint name="a" axis="0 1 0"/><inertial pos=".1 0 -.2" mass="1" diaginertia=".01 .02 .015"/>
    <body pos="0 .1 -.4" gravcomp=".5"><joint name="b" axis="1 0 1" pos=".1 .2 0"/><joint name="c" type="slide"/>
      <inertial pos=".1 .1 -.1" mass="2" diaginertia=".01 .02 .015"/></body></body></worldbody>
  <tendon><fixed name="t"><joint joint="a" coef="1"/><joint joint="c" coef=".5"/></fixed></tendon>
  <actuator><motor joint="a" gear="3"/><motor tendon="t"/></actuator></mujoco>"""


def fields():
    """Arrays of numbers of MuJoCo's compiled model, and its options: whatever a later version adds is among them."""
    model = mujoco.MjModel.from_xml_string(TREE)
    of_elements = [x for x in dir(model) if x.startswith(FAMILIES)]
    of_options = [f"opt.{x}" for x in dir(model.opt) if not x.startswith("_")]
    for name in (*of_elements, *of_options):
        owner = model.opt if name.startswith("opt.") else model
        values = np.asarray(getattr(owner, name.removeprefix("opt.")))
        if values.dtype == float and values.size:
            yield name


@pytest.mark.parametrize("field", [*fields()])
def test_every_number_of_a_compiled_model_is_in_the_equations_or_refused_by_name(tmp_path, field):
    path, rng = tmp_path / "tree.xml", np.random.default_rng(0)
    path.write_text(TREE)
    model = copy.copy(read_description(path).compiled)
    owner, name = (model.opt, field[4:]) if field.startswith("opt.") else (model, field)
    shape = np.shape(getattr(owner, name))
    turned = name in ("body_quat", "body_iquat", "jnt_axis")
    values = rng.uniform(0.1, 0.5, shape)
    values = values / np.linalg.norm(values, axis=-1, keepdims=True) if turned else values
    setattr(owner, name, values if shape else float(values))
    model.body_sameframe[:], model.body_simple[:], model.dof_simplenum[:] = 0, 0, 0  # as the compiler found them before
    try:
        check_forces("tree", described("tree", model, {}, "tree"))
    except ModelError as error:
        attribute = re.sub("^(opt.|body_|jnt_|dof_|tendon_|actuator_)", "", field).replace("poly", "")
        assert attribute in str(error)  # noqa: PT017  # most fields are in the equations, and raise nothing
