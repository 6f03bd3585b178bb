"""Estimates in files of robots: what a simulator reads there, and bodies that are possible."""

from xml.etree import ElementTree

import numpy as np
import pytest

import diransac as dr
import robots
from diransac import models
from diransac.errors import ModelError
from diransac.model.robots.calibration import calibrated, impossible_changes
from diransac.model.robots.consistency import consistent_parameters
from diransac.model.robots.description import read_description
from diransac.model.robots.rigid_body import inertial_parameters

mujoco = pytest.importorskip("mujoco", reason="FILES OF ROBOTS NOT CHECKED: mujoco is missing")

# Estimates are taken to be no better than 1e-4 of what they combine, a few of which add up.
LEAST_ERROR = 5e-4


@pytest.fixture
def described(tmp_path):
    """Function that writes a description under a name, and returns its path."""

    def write(text, name="robot"):
        path = tmp_path / (f"{name}.urdf" if "<robot" in text else f"{name}.xml")
        path.write_text(text)
        return path

    return write


def nominal(model):
    return model.parameter_vector({n: x.value for n, x in model.parameters.items()})


def forces(path, count=6, seed=0):
    """Forces of random motions by MuJoCo."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data, found = mujoco.MjData(model), []
    for q, v, a in np.random.default_rng(seed).normal(size=(count, 3, model.nv)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
        mujoco.mj_inverse(model, data)
        found.append(np.array(data.qfrc_inverse))
    return np.array(found)


# ---------------------------------------------------------------------- text


MJCF = """<?xml version='1.0'?>
<mujoco model="two">  <!-- a comment > with a bracket -->
  <compiler angle="radian"/>
  <default><default class="motor"><joint armature="0.01" damping="0.1 0.02"/></default></default>
  <worldbody>
    <body name="upper"><joint name="s" class="motor" axis="0 1 0" frictionloss='0.3'
      armature="0.02"/><geom size="0.1" mass="1"/>
      <body name="lower" pos="0 0 -0.3"><inertial pos="0 0 -.1" mass=".5" diaginertia=".01 .01 .01"/>
        <joint name="e" class="motor" axis="0 1 0"></joint></body></body>
  </worldbody>
  <actuator><motor name="s" joint="s"/></actuator>
</mujoco>
"""


def test_only_identified_values_change_in_an_mjcf_file(described):
    path = described(MJCF)
    model = models.robot(path, unknown=("armature", "damping", "friction", "spring", "offset"))
    values = np.arange(1.0, model.n_p + 1)
    text, left_out = calibrated(path, model.parameters, values, np.eye(model.n_p))
    expected = MJCF.replace(
        """frictionloss='0.3'
      armature="0.02"/>""",
        """frictionloss="3.0"
      armature="1.0" damping="2.0 0.02" stiffness="4.0"/>""",
    ).replace(
        '<joint name="e" class="motor" axis="0 1 0"></joint>',
        '<joint name="e" class="motor" axis="0 1 0" armature="6.0" damping="7.0 0.02" frictionloss="8.0"'
        ' stiffness="9.0"></joint>',
    )
    assert text == expected
    assert left_out == ("offset_s", "offset_e")
    again = models.robot(described(text, "again"), unknown=("armature", "damping", "friction", "spring", "offset"))
    assert nominal(again) == pytest.approx([1, 2, 3, 4, 0, 6, 7, 8, 9, 0])


def test_only_identified_values_change_in_a_urdf_file(described):
    source = robots.urdf(parents=(0, 1)).replace('<dynamics damping="0.4" friction="0.2"/>', "", 1)
    path = described(f"<!-- made by hand -->\n{source}")
    model = models.robot(path)
    text, left_out = calibrated(path, model.parameters, np.arange(1.0, 7.0), np.eye(6))
    assert left_out == ("armature_joint_1", "armature_joint_2")
    first, second = (joint.find("dynamics").attrib for joint in list(ElementTree.fromstring(text).iter("joint"))[:2])
    assert (first, second) == ({"damping": "2.0", "friction": "3.0"}, {"damping": "5.0", "friction": "6.0"})
    assert text.startswith("<!-- made by hand -->\n")
    untouched = text.replace('<dynamics damping="2.0" friction="3.0"/>', "")
    assert untouched.replace('damping="5.0" friction="6.0"', 'damping="0.4" friction="0.2"') == path.read_text()


def test_a_joint_in_an_included_file_is_named(described, tmp_path):
    (tmp_path / "legs.xml").write_text(MJCF[MJCF.index("<mujoco") :])
    path = described('<mujoco><include file="legs.xml"/></mujoco>', "scene")
    model = models.robot(path)
    with pytest.raises(ModelError, match=r'joint "s" is not in this file by name; write the files that it includes'):
        calibrated(path, model.parameters, 2.0 * nominal(model), np.eye(model.n_p))


def test_parameters_of_another_model_are_refused(described):
    other = models.servo_axis()
    with pytest.raises(ModelError, match="mass is no parameter of a robot's description"):
        calibrated(described(MJCF), other.parameters, np.ones(4), np.eye(4))


def test_a_joint_that_the_description_lacks_is_named(described):
    model = models.robot(described(MJCF))
    other = MJCF.replace('="s"', '="other"')
    with pytest.raises(ModelError, match='there is no joint "s" in the description'):
        calibrated(described(other, "other"), model.parameters, nominal(model), np.eye(model.n_p))


# ---------------------------------------------------------------------- bodies


@pytest.mark.parametrize("parents", [(0, 1, 2, 3, 4, 5), (0, 1, 1, 2, 0, 5)])
def test_a_simulator_reads_the_estimated_robot(described, parents):
    """Base parameters of another robot give its forces, by bodies that need not be its own."""
    path = described(robots.urdf(parents=parents))
    other = described(robots.urdf(parents=parents, inertials=5), "other")
    model, theirs = models.robot(path, bodies="all"), models.robot(other, bodies="all")
    covariance = np.diag((1e-6 * np.abs(nominal(theirs)) + 1e-9) ** 2)
    text, _ = calibrated(path, model.parameters, nominal(theirs), covariance)
    found = described(text, "found")
    assert forces(found) == pytest.approx(forces(other), abs=LEAST_ERROR * np.abs(forces(other)).max())
    masses = [mujoco.MjModel.from_xml_path(str(x)).body_mass for x in (path, other, found)]
    assert np.abs(masses[2] - masses[1]).max() > 0.05  # what no motion shows, is near the description's
    pinocchio = pytest.importorskip("pinocchio", reason="PINOCCHIO NOT COMPARED: pin is missing")
    assert pinocchio.buildModelFromUrdf(str(found)).nv == 6


def test_inertials_of_mjcf_are_those_of_the_frame_of_the_body(described):
    path = described(robots.panda_like(couplings=False))
    other = described(robots.panda_like(3, couplings=False), "other")
    model, theirs = models.robot(path, bodies="all"), models.robot(other, bodies="all")
    covariance = np.diag((1e-6 * np.abs(nominal(theirs)) + 1e-9) ** 2)
    text, left_out = calibrated(path, model.parameters, nominal(theirs), covariance)
    expected = forces(other)
    assert forces(described(text, "found")) == pytest.approx(expected, abs=LEAST_ERROR * np.abs(expected).max())
    assert left_out == ()


def test_a_body_of_which_nothing_is_known_stays_as_it_is(described):
    path = described(robots.urdf())
    model = models.robot(path, bodies=("link3",), unknown=("damping",))
    missing = np.full(model.n_p, np.nan)
    text, left_out = calibrated(path, model.parameters, missing, np.eye(model.n_p))
    assert text == path.read_text()
    assert left_out == tuple(model.parameters)


def test_bodies_are_possible_whatever_was_estimated(described):
    path = described(robots.urdf(parents=(0, 1)))
    model = models.robot(path, bodies="all")
    values = np.array(
        [x.value if n.startswith(("arm", "dam", "fri")) else -x.value for n, x in model.parameters.items()]
    )
    text, _ = calibrated(path, model.parameters, values, np.diag((0.1 * nominal(model)) ** 2 + 1e-9))
    bodies = read_description(described(text, "found")).bodies
    moving = [body.inertial for body in bodies if body.joints]
    assert all(np.linalg.eigvalsh(inertial)[0] > 0.0 for inertial in moving)


def random_problem(seed):
    rng = np.random.default_rng(seed)
    description = [robots.inertial(rng) for _ in range(3)]
    bodies = []
    for mass, c, I in description:
        J = np.zeros((4, 4))
        J[:3, :3] = 0.5 * np.trace(I) * np.eye(3) - I + mass * np.outer(c, c)
        J[:3, 3] = J[3, :3] = mass * c
        J[3, 3] = mass
        bodies.append(inertial_parameters(J))
    B = rng.normal(size=(12, 32))
    values = B @ np.concatenate([np.ravel(bodies) * rng.uniform(0.5, 1.5, 30), [0.0, 0.4]])
    spread = np.diag(rng.uniform(0.01, 0.1, 12))
    mixed = np.eye(12) + 0.2 * rng.normal(size=(12, 12))
    return np.array(bodies), np.array([0.0, 0.3]), B, values, spread @ mixed @ mixed.T @ spread


def cost(bodies, constants, problem):
    """Squared error by its covariance, and divergences from the description, as they are defined."""
    first, of_first, B, values, covariance = problem
    error = B @ np.concatenate([bodies.ravel(), constants]) - values
    total = 0.5 * error @ np.linalg.solve(covariance, error)
    for own, theirs in zip(bodies, first, strict=True):
        J, J0 = (_pseudo(x) for x in (own, theirs))
        if np.linalg.eigvalsh(J)[0] <= 0.0:
            return np.inf
        ratio = J @ np.linalg.inv(J0)
        total += np.trace(ratio) - np.log(np.linalg.det(ratio)) - 4.0
    ratio = constants[1] / of_first[1]
    return total + ratio - np.log(ratio) - 1.0


def _pseudo(x):
    m, hx, hy, hz, xx, yy, zz, xy, xz, yz = x
    inertia, h = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), np.array([[hx], [hy], [hz]])
    return np.block([[0.5 * np.trace(inertia) * np.eye(3) - inertia, h], [h.T, np.array([[m]])]])


@pytest.mark.parametrize("seed", range(5))
def test_consistent_parameters_are_the_optimum(seed):
    problem, rng = random_problem(seed), np.random.default_rng(100 + seed)
    bodies, constants = consistent_parameters(*problem)
    least = cost(bodies, constants, problem)
    assert least < cost(problem[0], problem[1], problem)
    assert constants[0] == 0.0
    for size in (1e-2, 1e-3, 1e-4):
        for _ in range(20):
            other = bodies * (1.0 + size * rng.normal(size=bodies.shape))
            assert cost(other, constants * (1.0 + size * rng.normal(size=2)), problem) > least - 1e-9


def test_a_combination_without_error_is_met():
    bodies, constants, B, values, covariance = random_problem(0)
    covariance[3, :] = covariance[:, 3] = 0.0
    found = consistent_parameters(bodies, constants, B, values, covariance)
    size = np.abs(B[3]) @ np.abs([*bodies.ravel(), *constants])
    assert B[3] @ [*found[0].ravel(), *found[1]] == pytest.approx(values[3], abs=LEAST_ERROR * size)


def test_an_impossible_description_is_refused():
    problem = random_problem(0)
    problem[0][1, 0] = -1.0
    with pytest.raises(ModelError, match="is impossible: give it a positive mass"):
        consistent_parameters(*problem)


def test_a_result_writes_the_description_with_its_estimates(described, tmp_path):
    path = described(robots.urdf(parents=(0, 1)))
    model = models.robot(path, unknown=("damping", "friction", "offset"))
    rng, t = np.random.default_rng(0), np.arange(0.0, 4.0, 0.01)
    w = rng.uniform(1.0, 4.0, 2)
    q, v, a = np.sin(t[:, None] * w), w * np.cos(t[:, None] * w), -(w**2) * np.sin(t[:, None] * w)
    truth = np.array([0.7, 0.5, 0.1, 0.9, 0.3, -0.2])
    tau = np.array([model.residual(*x, [0.0, 0.0], truth) for x in zip(q, v, a, strict=True)])[:, :, 0]
    signals = {f"joint_{k}{suffix}": x[:, k - 1] for k in (1, 2) for suffix, x in (
        ("", q), ("_dot", v), ("_ddot", a), ("_torque", tau)
    )}  # fmt: skip
    result = dr.identify(model, dr.Log.from_arrays(t, signals), "ols")
    assert result.export(tmp_path / "calibrated.urdf", into=path) == ("offset_joint_1", "offset_joint_2")
    again = models.robot(tmp_path / "calibrated.urdf", unknown=("damping", "friction"))
    assert nominal(again) == pytest.approx([0.7, 0.5, 0.9, 0.3])
    assert dr.Result.load(saved(result, tmp_path)).export(tmp_path / "calibrated.urdf", into=path)


def saved(result, folder):
    result.save(folder / "result.json")
    return folder / "result.json"


def test_base_parameters_of_no_possible_body_are_found_and_noise_is_not(described):
    model = models.robot(described(robots.urdf(parents=(0, 1, 2))), bodies="all", unknown=("friction",))
    values, rng = nominal(model), np.random.default_rng(0)
    spread = 0.02 * np.abs(values) + 1e-4
    noisy = values + spread * rng.standard_normal(len(values))
    changes = impossible_changes(model.parameters, noisy, np.diag(spread**2))
    assert set(changes) < set(model.parameters)
    assert max(map(abs, changes.values())) < 2.0
    k = next(k for k, name in enumerate(model.parameters) if name.startswith("Izz"))
    values[k] = -values[k]
    changes = impossible_changes(model.parameters, values, np.diag(spread**2))
    assert max(map(abs, changes.values())) > 10.0
    spread[k] = np.inf
    assert max(map(abs, impossible_changes(model.parameters, values, np.diag(spread**2)).values())) < 0.1


def test_a_result_with_impossible_bodies_says_so(described):
    text = """<mujoco><compiler angle="radian"/><worldbody><body name="arm"><joint name="elbow" axis="0 0 1"/>
      <inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.01 0.01"/></body></worldbody></mujoco>"""
    model, t = models.robot(described(text), bodies="all", unknown=("damping",)), np.arange(0.0, 6.0, 0.01)
    q, v, a = np.sin(3.0 * t), 3.0 * np.cos(3.0 * t), -9.0 * np.sin(3.0 * t)
    verdicts = []
    for inertia in (0.02, -0.02):
        torque = inertia * a + 0.1 * v + 1e-4 * np.random.default_rng(0).standard_normal(len(t))
        log = dr.Log.from_arrays(t, {"elbow": q, "elbow_dot": v, "elbow_ddot": a, "elbow_torque": torque})
        findings = dr.identify(model, log, method="ols").findings
        verdicts.append(any("No possible bodies" in str(x) for x in findings))
    assert verdicts == [False, True]


def test_drake_reads_the_estimated_robot(described):
    drake = pytest.importorskip("pydrake.all", reason="DRAKE DOES NOT READ ROBOTS: pip install 'diransac[drake]'")
    path = described(robots.urdf())
    model = models.robot(path, bodies="all")
    text, _ = calibrated(path, model.parameters, nominal(model), np.diag((0.01 * nominal(model)) ** 2 + 1e-12))
    plant = drake.MultibodyPlant(0.0)
    (index,) = drake.Parser(plant).AddModels(str(described(text, "found")))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("link0"))
    plant.Finalize()
    assert plant.num_velocities() == 6
    mass = sum(float(x.attrib["value"]) for x in ElementTree.fromstring(text).iter("mass"))
    assert plant.CalcTotalMass(plant.CreateDefaultContext(), [index]) == pytest.approx(mass)
