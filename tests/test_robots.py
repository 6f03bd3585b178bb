"""Models from descriptions of robots, against MuJoCo's and Pinocchio's inverse dynamics, and motions with these."""

import sys
from xml.etree import ElementTree

import numpy as np
import pytest

import diransac as dr
import robots
from diransac.errors import ModelError
from diransac.model.robots.mechanism import identifier as robots_identifier

mujoco = pytest.importorskip("mujoco", reason="MODELS OF ROBOTS NOT CHECKED: mujoco is missing")

EXACT = 1e-10
ROBOTS = {
    "panda-like": lambda seed: robots.panda_like(seed, couplings=False),
    "quadruped": robots.quadruped,
    "unusual": robots.unusual,
    "six-axes": robots.urdf,
    "tree": lambda seed: robots.urdf(seed, (0, 1, 1, 2, 0, 5), ["revolute", "prismatic", *["continuous"] * 4]),
}
EVERY_ROBOT = pytest.mark.parametrize("kind", ROBOTS)
SEEDS = range(3)


@pytest.fixture
def described(tmp_path):
    """Function that writes a description, and returns its path."""

    def write(text):
        path = tmp_path / ("robot.urdf" if text.startswith("<robot") else "robot.xml")
        path.write_text(text)
        return path

    return write


def compiled(path, without_constraints=True):
    """MuJoCo's model of a file, by its own reading, and its data."""
    model = mujoco.MjModel.from_xml_path(str(path))
    if without_constraints:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    return model, mujoco.MjData(model)


def inverse(model, data, q, v, a):
    """Forces of the drives by MuJoCo, without dry friction."""
    data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
    mujoco.mj_inverse(model, data)
    return np.array(data.qfrc_inverse)


def motions(n, count=5, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 3, n))


def required(model, q, v, a, p):
    """Forces that the motion takes by a diransac model: its residual without inputs."""
    return np.array(model.residual(q, v, a, np.zeros(model.n_u), p)).ravel()


def without_friction(model, **values):
    """Nominal parameters without friction, in the model's order."""
    nominal = {n: 0.0 if n.startswith("friction") else x.value for n, x in model.parameters.items()}
    return model.parameter_vector(nominal | values)


# ---------------------------------------------------------------------- rigid bodies


@EVERY_ROBOT
@pytest.mark.parametrize("seed", SEEDS)
def test_forces_are_those_of_mujoco(described, kind, seed):
    path = described(ROBOTS[kind](seed))
    model, (reference, data) = dr.models.robot(path), compiled(path)
    p = without_friction(model)
    for q, v, a in motions(model.n_q, seed=seed):
        expected = inverse(reference, data, q, v, a)
        assert required(model, q, v, a, p) == pytest.approx(expected, abs=EXACT * (1 + np.abs(expected).max()))


@EVERY_ROBOT
def test_accelerations_are_those_of_mujoco(described, kind):
    path = described(ROBOTS[kind](0))
    model, (reference, data) = dr.models.robot(path), compiled(path)
    p, rng = without_friction(model), np.random.default_rng(0)
    for q, v, tau in motions(model.n_q):
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, v, rng.normal() * tau
        mujoco.mj_forward(reference, data)
        found = np.array(model.dynamics(np.hstack([q, v]), data.qfrc_applied, p)[1]).ravel()
        assert found == pytest.approx(data.qacc, abs=1e-8 * (1 + np.abs(data.qacc).max()))


@pytest.mark.parametrize("kind", ["panda-like", "quadruped", "six-axes", "tree"])
@pytest.mark.parametrize("seed", SEEDS)
def test_forces_are_those_of_pinocchio(described, kind, seed):
    pinocchio = pytest.importorskip("pinocchio", reason="PINOCCHIO NOT COMPARED: pin is missing")
    path = described(ROBOTS[kind](seed))
    of_urdf = path.suffix == ".urdf"
    reference = (pinocchio.buildModelFromUrdf if of_urdf else pinocchio.buildModelFromMJCF)(str(path))
    reference.armature[:] = reference.damping[:] = 0.0
    model = dr.models.robot(path)
    p = model.parameter_vector(dict.fromkeys(model.parameters, 0.0))
    names = [name.replace("-", "_") for name in reference.names]
    for q, v, a in motions(model.n_q, seed=seed):
        theirs = [np.zeros(reference.nq), np.zeros(reference.nv), np.zeros(reference.nv)]
        for joint, x in zip(model.coordinates, zip(q, v, a, strict=True), strict=True):
            at = reference.joints[names.index(joint)]
            theirs[0][at.idx_q : at.idx_q + at.nq] = x[0] if at.nq == 1 else (np.cos(x[0]), np.sin(x[0]))
            theirs[1][at.idx_v], theirs[2][at.idx_v] = x[1:]
        forces = pinocchio.rnea(reference, reference.createData(), *theirs)
        expected = np.array([forces[reference.joints[names.index(joint)].idx_v] for joint in model.coordinates])
        assert required(model, q, v, a, p) == pytest.approx(expected, abs=EXACT * (1 + np.abs(expected).max()))


@pytest.mark.parametrize("kind", ["panda-like", "quadruped", "six-axes", "tree"])
def test_forces_are_those_of_drake(described, kind):
    """With damping, which Drake counts among a machine's own forces; armatures are left out."""
    drake = pytest.importorskip("pydrake.all", reason="DRAKE NOT COMPARED: pip install 'diransac[drake]'")
    path = described(ROBOTS[kind](0))
    plant, model = drake.MultibodyPlant(0.0), dr.models.robot(path)
    drake.Parser(plant).AddModels(str(path))
    if path.suffix == ".urdf":
        plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("link0"))
    plant.Finalize()
    context, every = plant.CreateDefaultContext(), map(plant.get_joint, plant.GetJointIndices())
    at = {joint.name().replace("-", "_"): joint for joint in every}
    places = [at[name].velocity_start() for name in model.coordinates]
    own = {n: x.value if n.startswith("damping") else 0.0 for n, x in model.parameters.items()}
    for q, v, a in motions(model.n_q):
        states, theirs = np.zeros((2, model.n_q)), np.zeros(model.n_q)
        states[:, places], theirs[places] = (q, v), a
        plant.SetPositionsAndVelocities(context, states.ravel())
        forces = drake.MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)
        expected = plant.CalcInverseDynamics(context, theirs, forces)[places]
        found = required(model, q, v, a, model.parameter_vector(own))
        assert found == pytest.approx(expected, abs=EXACT * (1 + np.abs(expected).max()))


def test_a_real_description_has_the_forces_of_mujoco(shared_data):
    path = shared_data / "unitree_go2" / "go2.xml"
    model, (reference, data) = dr.models.robot(path), compiled(path)
    assert model.n_q == 12
    for q, v, a in motions(12):
        expected = inverse(reference, data, q, v, a)
        assert required(model, q, v, a, without_friction(model)) == pytest.approx(expected, abs=EXACT)


def test_inertials_of_fixed_bodies_count_once(described):
    path = described(robots.urdf())
    model, (reference, data) = dr.models.robot(path, joints=["joint-6"]), compiled(path)
    (q, v, a), p = motions(6, 1)[0], without_friction(model)
    q[:5] = v[:5] = a[:5] = 0.0
    assert required(model, q[5:], v[5:], a[5:], p) == pytest.approx(inverse(reference, data, q, v, a)[5:])


LINK = '<inertial pos="0 0 -.2" mass="1" diaginertia=".01 .02 .015"/>'
HINGE = f'<mujoco>{{}}<worldbody><body {{}}><joint name="j" axis="0 1 0" {{}}/>{LINK}</body></worldbody>{{}}</mujoco>'


@pytest.mark.parametrize(
    ("options", "joint", "drive", "q", "v", "force"),
    [
        ("", 'stiffness="5 2 1"', "", -0.5, 0.0, -2.125),
        ("", 'stiffness="5 2 1"', "", 0.5, 0.0, 3.125),
        ("", 'damping="1 2 4"', "", 0.0, -0.5, -1.5),
        ('<option><flag gravity="disable"/></option>', "", "", 0.7, 0.0, 0.0),
        ('<option><flag gravity="disable" spring="disable"/></option>', 'stiffness="5"', "", 0.7, 0.0, 0.0),
        ('<option><flag damper="disable"/></option>', 'damping="5"', "", 0.0, 0.7, 0.0),
        ("", 'damping="1"', 'gear="-10" armature=".0005" damping=".001 .002"', 0.0, 2.0, 2.0 + 0.2 + 0.8),
    ],
)
def test_attributes_act_as_in_mujoco(described, options, joint, drive, q, v, force):
    text = HINGE.format(options, "", joint, f'<actuator><motor joint="j" {drive}/></actuator>')
    model = dr.models.robot(described(text))
    weight = 0.0 if "gravity" in options else 0.2 * 9.81 * np.sin(q)
    assert required(model, [q], [v], [0.0], without_friction(model)) == pytest.approx([force + weight])
    rotor = 0.05 if drive else 0.0
    inertia = required(model, [0.0], [0.0], [1.0], without_friction(model))
    assert inertia == pytest.approx([0.02 + 0.04 + rotor])
    assert model.parameters["armature_j"].value == pytest.approx(rotor)


def test_weight_that_drives_compensate_is_in_their_force(described):
    text = HINGE.format("", "", 'actuatorgravcomp="true"', "").replace(
        LINK, f'{LINK}<body pos="0 0 -.4" gravcomp="1"><joint name="k" axis="0 1 0"/>{LINK}</body>'
    )
    model = dr.models.robot(described(text))
    q = [0.5, 0.3]
    outer = 0.2 * 9.81 * np.sin(0.8)
    both = 0.2 * 9.81 * np.sin(0.5) + 0.4 * 9.81 * np.sin(0.5) + outer
    assert required(model, q, [0, 0], [0, 0], without_friction(model)) == pytest.approx([both, 0.0], abs=1e-12)


def test_disabled_equality_constraints_couple_nothing(described):
    free = dr.models.robot(
        described(robots.panda_like().replace("<worldbody>", '<option><flag equality="disable"/></option><worldbody>'))
    )
    assert {"left_finger", "right_finger"} <= set(free.coordinates)


# ---------------------------------------------------------------------- coupled, locked and free joints


def test_coupled_joints_move_by_virtual_work(described):
    path = described(robots.panda_like().replace('polycoef="0.001 1 0 0 0"', 'polycoef="0.001 1.2 3 0.5 0"'))
    model, (reference, data) = dr.models.robot(path), compiled(path)
    assert list(model.coordinates)[-1] == "left_finger"
    for q, v, a in motions(8):
        x = q[7]
        y, slope, curvature = 0.001 + 1.2 * x + 3 * x**2 + 0.5 * x**3, 1.2 + 6 * x + 1.5 * x**2, 6 + 3 * x
        forces = inverse(reference, data, [*q, y], [*v, slope * v[7]], [*a, slope * a[7] + curvature * v[7] ** 2])
        expected = np.array([*forces[:7], forces[7] + slope * forces[8]])
        assert required(model, q, v, a, without_friction(model)) == pytest.approx(expected, abs=1e-9)


def test_joints_of_a_urdf_mimic_others(described):
    first, second = robots.urdf(parents=(0, 1)).split('<joint name="joint-2"')
    mimic = '<mimic joint="joint-1" multiplier="-2" offset="0.3"/><limit'
    path = described(f'{first}<joint name="joint-2"{second.replace("<limit", mimic, 1)}')
    model, (reference, data) = dr.models.robot(path), compiled(path)
    (x, w, b), p = motions(1, 1)[0], without_friction(model)
    forces = inverse(reference, data, [x[0], 0.3 - 2 * x[0]], [w[0], -2 * w[0]], [b[0], -2 * b[0]])
    assert list(model.coordinates) == ["joint_1"]
    # The follower's friction is known, and acts on the leader: 2 * 0.2 N m at full speed.
    friction = -2 * 0.2 * np.tanh(-2 * w[0] / 0.05)
    assert required(model, x, w, b, p) == pytest.approx([forces[0] - 2 * forces[1] + friction])


def test_joints_that_are_not_named_are_locked(described):
    path = described(robots.quadruped())
    model, (reference, data) = dr.models.robot(path, joints={"thigh": "FL_thigh_joint"}), compiled(path)
    assert list(model.coordinates) == ["thigh"]
    assert list(model.parameters) == ["armature_thigh", "damping_thigh", "friction_thigh"]
    q, v, a = np.zeros((3, 12))
    q[1], v[1], a[1] = 0.4, 0.5, 0.6
    expected = inverse(reference, data, q, v, a)[1]
    assert required(model, 0.4, 0.5, 0.6, without_friction(model)) == pytest.approx([expected])


def test_a_base_that_was_held_is_fixed_on_request(described):
    floating = described(robots.quadruped(base="<freejoint/>"))
    with pytest.raises(ModelError, match=r"the base floats.*base=\"held\""):
        dr.models.robot(floating)
    held = dr.models.robot(floating, base="held")
    assert held == dr.models.robot(described(robots.quadruped()))


def test_a_base_whose_motion_is_measured_carries_its_limbs(described):
    path = described(robots.quadruped(base="<freejoint/>"))
    model, (reference, data) = dr.models.robot(path, base="measured", bodies="all"), compiled(path)
    assert list(model.inputs)[12:15] == ["base_wx", "base_wy", "base_wz"]
    p, rng, R = without_friction(model), np.random.default_rng(1), np.zeros(9)
    for q, v, a in motions(12):
        data.qpos[:3], data.qpos[3:7] = rng.normal(size=3), rng.normal(size=4)
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        data.qpos[7:], data.qvel[:], data.qacc[:] = q, [*rng.normal(size=6), *v], [*rng.normal(size=6), *a]
        mujoco.mj_inverse(reference, data)
        mujoco.mju_quat2Mat(R, data.qpos[3:7])
        f = R.reshape(3, 3).T @ (data.qacc[:3] - reference.opt.gravity)
        u = [*np.zeros(12), *data.qvel[3:6], *data.qacc[3:6], *f]
        found = np.array(model.residual(q, v, a, u, p)).ravel()
        assert found == pytest.approx(data.qfrc_inverse[6:], abs=1e-9)
    with pytest.raises(ModelError, match="0 bodies have a free joint"):
        dr.models.robot(described(robots.quadruped()), base="measured")
    with pytest.raises(ModelError, match="base is 'clamped'"):
        dr.models.robot(path, base="clamped")


def test_gravity_can_be_another(described):
    path = described(robots.urdf())
    model, (reference, data) = dr.models.robot(path, gravity=(0, 9.81, 0)), compiled(path)
    reference.opt.gravity[:] = 0, 9.81, 0
    q, v, a = motions(6, 1)[0]
    expected = inverse(reference, data, q, v, a)
    assert required(model, q, v, a, without_friction(model)) == pytest.approx(expected, abs=1e-9)


def test_meshes_need_not_be_there(described):
    with_mesh = dr.models.robot(described(robots.urdf(mesh=True)))
    assert with_mesh == dr.models.robot(described(robots.urdf()))


# ---------------------------------------------------------------------- refused descriptions


END = "</worldbody>"
CALF = '<joint name="FL_calf_joint"'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (END, f'{END}<equality><connect body1="FL_calf" body2="FR_calf" anchor="0 0 0"/></equality>', "kinematic loop"),
        (END, f'{END}<equality><weld name="tie" body1="FL_calf"/></equality>', r'"tie" \(weld\) closes'),
        (
            END,
            f'<body name="hand" mocap="true"/>{END}<equality><weld body1="FL_calf" body2="hand"/></equality>',
            'ties the robot to "hand", a mocap body',
        ),
        (f'{CALF} axis="0 1 0"', f'{CALF} type="ball"', "ball joint; replace"),
        (
            END,
            f'{END}<tendon><fixed stiffness="3"><joint joint="FL_calf_joint" coef="1"/></fixed></tendon>',
            r'stiffness of tendon "0" acts on its joints, by up to .* leave it out',
        ),
        ("<worldbody>", '<option density="1.2"/><worldbody>', "density acts on its joints"),
        (CALF, f'{CALF} stiffness="5" springyield=".2"', r"springs that yield \(springyield\)"),
        (
            END,
            f'{END}<tendon><fixed name="cord" damping="0 3"><joint joint="FL_calf_joint" coef="1"/></fixed></tendon>',
            r'damping \(polynomial\) of tendon "cord" acts',
        ),
        (
            END,
            f'{END}<tendon><fixed frictionloss="3"><joint joint="FL_calf_joint" coef="1"/></fixed></tendon>',
            "friction of a tendon is not modelled",
        ),
        ("<worldbody>", "<worldbdy>", "cannot be read: XML"),
        ("<joint", "<site", "cannot be read: XML"),
    ],
)
def test_descriptions_without_equations_here_are_refused(described, old, new, message):
    path = described(robots.quadruped().replace(old, new, 1))
    with pytest.raises(ModelError, match=message):
        dr.models.robot(path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"unknown": ["inertial"]}, "unknown: there is no 'inertial'; choose from armature, damping"),
        *(
            ({"unknown": ["damping", name]}, rf'\'{name}\' belongs to bodies: .* \(--bodies\), "all" or some of link0')
            for name in ("mass", "inertia", "com", "mass_hand", "Ixx_hand", "hx")
        ),
        ({"unknown": ["body/hand.mass"]}, r"'body/hand.mass' is a mask: .*\(--simulator mujoco\)"),
        ({"unknown": ["kp"]}, "'kp' is a gain of a drive: where .* give 1, and the unknown \"torque_gain\""),
        ({"unknown": []}, "nothing is unknown"),
        ({"joints": ["elbow"]}, "joints: there is no 'elbow'; choose from joint1"),
        ({"joints": []}, "no joint is modelled"),
        ({"joints": {"a": "joint1", "b": "joint1"}}, '"joint1" has several coordinates'),
        ({"joints": ["right_finger"]}, '"right_finger" follows another'),
        ({"bodies": ["link0"]}, '"link0" does not move'),
        ({"passive": ["joint9"]}, "passive: there is no 'joint9'"),
        ({"friction_speed": 0.0}, "friction_speed is 0.0; give a positive number"),
        ({"gravity": (0, 0)}, "give three finite numbers"),
    ],
)
def test_arguments_without_meaning_are_refused(described, arguments, message):
    with pytest.raises(ModelError, match=message):
        dr.models.robot(described(robots.panda_like()), **arguments)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ModelError, match=r'"none.xml" does not exist'):
        dr.models.robot("none.xml")


def test_a_missing_mujoco_is_named_with_the_command_that_installs_it(described, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ModelError, match=r"pip install 'diransac\[robots\]'"):
        dr.models.robot(described(robots.quadruped()))


# ---------------------------------------------------------------------- joints and drives


def one_joint(described, **arguments):
    """Model of one hinge without bodies' forces but for its inertia, with gravity off."""
    text = """<mujoco><compiler angle="radian"/><option gravity="0 0 0"/><worldbody><body name="disc">
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint name="j" axis="0 0 1" armature="0.5" damping="0.2"
      frictionloss="0.3" stiffness="2" springref="0.1"/></body></worldbody></mujoco>"""
    return dr.models.robot(described(text), **arguments)


def drive(model, q=0.0, v=0.0, **inputs):
    """Force of the drive at rest or in motion, by the residual with and without inputs."""
    p = model.parameter_vector({n: x.value for n, x in model.parameters.items()})
    u = [inputs[n] for n in model.inputs]
    return float(model.residual(q, v, 0.0, np.zeros(len(u)), p) - model.residual(q, v, 0.0, u, p))


def test_forces_of_a_joint_are_those_that_are_named(described):
    model = one_joint(described, unknown=("armature", "damping", "friction", "stribeck", "spring", "offset"))
    units = {n.removesuffix("_j"): x.unit for n, x in model.parameters.items()}
    assert units == {
        "armature": "kg m^2", "damping": "N m s/rad", "friction": "N m", "stribeck": "N m", "spring": "N m/rad",
        "offset": "N m",
    }  # fmt: skip
    nominal = {n.removesuffix("_j"): x.value for n, x in model.parameters.items()}
    expected = {"armature": 0.5, "damping": 0.2, "friction": 0.3, "stribeck": 0.0, "spring": 2.0, "offset": 0.0}
    assert nominal == pytest.approx(expected)
    q, v, a = 0.4, 0.15, 0.7
    p = dict(zip(units, (0.6, 0.7, 0.8, 0.9, 1.1, 1.2), strict=True))
    signals = [a, v, np.tanh(v / 0.05), np.tanh(v / 0.05) * np.exp(-((v / 0.2) ** 2)), q - 0.1, 1.0]
    force = 1.0 * a + sum(x * y for x, y in zip(p.values(), signals, strict=True))
    assert required(model, q, v, a, list(p.values())) == pytest.approx([force])


def test_position_control_follows_targets(described):
    control = dr.PositionControl(kp=20.0, kd={"j": 1.5}, target="des_{}", velocity="des_{}_dot", feedforward="{}_ff")
    model = one_joint(described, actuation=control)
    assert model.inputs == {"des_j": "rad", "des_j_dot": "rad/s", "j_ff": "N m"}
    force = drive(model, 0.3, 0.4, des_j=0.5, des_j_dot=0.6, j_ff=0.7)
    assert force == pytest.approx(20.0 * 0.5 + 1.5 * 0.6 + 0.7)
    at_rest = one_joint(described, actuation=dr.PositionControl(kp=20.0, kd=1.5), unknown=["armature"])
    assert required(at_rest, 0.3, 0.4, 0.0, 0.5) == pytest.approx(
        [0.2 * 0.4 + 0.3 * np.tanh(8.0) + 2 * 0.2 + 20 * 0.3 + 1.5 * 0.4]
    )


def test_drives_saturate(described):
    for actuation, inputs in (
        (dr.PositionControl(kp=100.0, limit=7.0), {"j_target": 5.0}),
        (dr.JointTorques(limit={"j": 7.0}), {"j_torque": 500.0}),
        (dr.MotorCurrents(constant=0.1, gear=50.0, limit=7.0), {"j_current": 500.0}),
    ):
        model = one_joint(described, actuation=actuation)
        assert drive(model, **inputs) == pytest.approx(7.0)
        assert drive(model, **{n: -x for n, x in inputs.items()}) == pytest.approx(-7.0)


def test_currents_act_by_gear_and_constant_and_gain(described):
    motor = dr.MotorCurrents(constant=0.05, gear=-100.0, current="i_{}")
    model = one_joint(described, actuation=motor, unknown=("torque_gain",))
    assert (model.inputs, list(model.parameters)) == ({"i_j": "A"}, ["torque_gain_j"])
    assert drive(model, i_j=2.0) == pytest.approx(-10.0)
    gain = model.residual(0, 0, 0, 2.0, 1.1) - model.residual(0, 0, 0, 0.0, 1.1)
    assert float(gain) == pytest.approx(11.0)


def test_a_passive_joint_has_no_input(described):
    model = dr.models.robot(described(robots.urdf(parents=(0, 1))), passive=["joint_2"])
    assert list(model.inputs) == ["joint_1_torque"]


def test_an_encoder_bias_moves_the_mechanism_but_not_the_control(described):
    control = dr.PositionControl(kp=20.0)
    biased = one_joint(described, actuation=control, unknown=("armature", "encoder_bias"))
    exact = one_joint(described, actuation=control, unknown=("armature",))
    shifted = required(biased, 0.35, 0.1, 0.2, [0.5, 0.05])
    assert shifted - required(exact, 0.3, 0.1, 0.2, 0.5) == pytest.approx([20.0 * 0.05])
    assert (biased.parameters["encoder_bias_j"].unit, biased.parameters["encoder_bias_j"].value) == ("rad", 0.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dr.PositionControl(kp=-1.0), "PositionControl: kp is -1; give a non-negative number"),
        (lambda: dr.PositionControl(kp=1.0, target="target"), "target is 'target'; give a pattern"),
        (lambda: dr.MotorCurrents(constant={"a": 0.0}), "constant is 0; give a positive number"),
        (lambda: dr.JointTorques(limit="large"), "limit is 'large'; give a number"),
        (lambda: dr.MotorCurrents(constant=None), "constant is None; where the constant is not known, give 1, and"),
        (lambda: dr.PositionControl(kp=None), 'kp is None; where the kp is not known, give 1, and the unknown "torq'),
    ],
)
def test_drives_without_meaning_are_refused(make, message):
    with pytest.raises(ModelError, match=message):
        make()


def test_a_gain_that_a_joint_lacks_is_named(described):
    with pytest.raises(ModelError, match="kp is given for elbow, but not for j"):
        one_joint(described, actuation=dr.PositionControl(kp={"elbow": 3.0}))


def test_limbs_are_independent_parts(described):
    path = described(robots.quadruped())
    whole, names = dr.models.robot(path), [f"{part}_joint" for part in ("hip", "thigh", "calf")]
    parts = dr.independent_parts(whole)
    assert list(parts) == ["FL", "FR", "RL", "RR"]
    q, v, a, p = *motions(12, 1)[0], without_friction(whole)
    forces = required(whole, q, v, a, p)
    for k, (leg, part) in enumerate(parts.items()):
        own = slice(3 * k, 3 * k + 3)
        assert list(part.coordinates) == [f"{leg}_{name}" for name in names]
        assert required(part, q[own], v[own], a[own], without_friction(part)) == pytest.approx(forces[own])
    assert list(dr.independent_parts(dr.models.robot(described(robots.panda_like())))) == ["arm"]


# ---------------------------------------------------------------------- base parameters


def values_of(model, truth):
    """Base parameters of a model from values of all parameters."""
    return model.parameter_vector(
        {n: sum(weight * truth[place] for place, weight in x.combination) for n, x in model.parameters.items()}
    )


def described_values(path, reference):
    """All values by their places: inertials of a file's links about the origins of their frames, MuJoCo's of joints."""
    found = {}
    for k in range(reference.njnt):
        name = reference.joint(k).name
        found |= {f"armature {name}": reference.dof_armature[k], f"damping {name}": reference.dof_damping[k]}
    for link in ElementTree.parse(path).iter("link"):
        if link.find("inertial") is not None:
            m = float(link.find("inertial/mass").get("value"))
            c = np.array([float(x) for x in link.find("inertial/origin").get("xyz").split()])
            entry = {key: float(x) for key, x in link.find("inertial/inertia").items()}
            order = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
            shift = m * (c @ c * np.eye(3) - np.outer(c, c))
            moved = dict(zip(order, (*np.diag(shift), shift[0, 1], shift[0, 2], shift[1, 2]), strict=True))
            name = link.get("name")
            found |= {f"I{key[1:]} {name}": entry[key] + moved[key] for key in order}
            found |= {f"mass {name}": m, **{f"h{axis} {name}": m * x for axis, x in zip("xyz", c, strict=True)}}
    return found


@pytest.mark.parametrize("parents", [(0, 1, 2, 3, 4, 5), (0, 1, 1, 2, 0, 5)])
def test_base_parameters_give_the_forces_of_any_inertials(described, parents):
    described_first = described(robots.urdf(parents=parents))
    model = dr.models.robot(described_first, bodies="all", unknown=("armature", "damping"))
    path = described(robots.urdf(parents=parents, inertials=7))
    reference, data = compiled(path)
    reference.dof_armature[:] = np.arange(1, 7)
    reference.dof_damping[:] = np.arange(7, 13)
    p = values_of(model, described_values(path, reference))
    for q, v, a in motions(6):
        expected = inverse(reference, data, q, v, a) + 0.2 * np.tanh(v / 0.05)
        assert required(model, q, v, a, p) == pytest.approx(expected, abs=EXACT * (1 + np.abs(expected).max()))


def test_base_parameters_are_as_many_as_in_the_literature(described):
    """Of a general arm with hinges, the first link has 3, or 1 with its axis along gravity, and each further one 7.

    Gautier and Khalil 1990, "Direct calculation of minimum set of inertial parameters of serial robots".
    """
    path = described(robots.urdf())
    arm = dr.models.robot(path, unknown=(), bodies="all")
    assert arm.n_p == 3 + 5 * 7
    assert arm.is_affine
    assert arm.force_sign == 1
    reference, data = compiled(path)
    mujoco.mj_forward(reference, data)
    assert dr.models.robot(path, unknown=(), bodies="all", gravity=9.81 * data.xaxis[0]).n_p == 1 + 5 * 7


def test_parameters_that_only_a_sum_shows_are_grouped_by_name(described):
    text = """<mujoco><worldbody><body name="upper"><joint name="s" axis="0 1 0"/>
      <inertial pos="0 0 -.1" mass="1" diaginertia=".02 .02 .02"/><body name="lower" pos="0 0 -.3">
      <joint name="e" axis="0 1 0"/><inertial pos="0 0 -.1" mass=".5" diaginertia=".01 .01 .01"/></body></body>
      </worldbody></mujoco>"""
    model = dr.models.robot(described(text), unknown=(), bodies=("upper", "lower"))
    combinations = {n: dict(x.combination) for n, x in model.parameters.items()}
    assert combinations == {
        "hx_upper": {"hx upper": 1.0},
        "hz_upper_grouped": {"hz upper": 1.0, "mass lower": -0.3},
        "Iyy_upper_grouped": {"Iyy upper": 1.0, "mass lower": 0.09},
        "hx_lower": {"hx lower": 1.0},
        "hz_lower": {"hz lower": 1.0},
        "Iyy_lower": {"Iyy lower": 1.0},
    }
    assert model.parameters["Iyy_upper_grouped"].value == pytest.approx(0.03 + 0.5 * 0.09)
    assert dr.Model.from_dict(model.to_dict()) == model
    assert dr.Model.from_dict(model.to_dict()).parameters == model.parameters


# ---------------------------------------------------------------------- identification


def moved(path, n_q, duration=8.0, dt=0.01, seed=0, friction=0.0):
    """Log of smooth motions, with the torques that MuJoCo finds for them and smoothed dry friction."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, duration, dt)
    w, phase, size = rng.uniform(1.0, 6.0, (3, n_q)), rng.uniform(0, 6, (3, n_q)), rng.uniform(0.1, 0.4, (3, n_q))
    angles = t[:, None, None] * w + phase
    q, v, a = (size * np.sin(angles)).sum(1), (size * w * np.cos(angles)).sum(1), -(size * w**2 * np.sin(angles)).sum(1)
    model, data = compiled(path)
    tau = np.array([inverse(model, data, *x) for x in zip(q, v, a, strict=True)]) + friction * np.tanh(v / 0.05)
    return t, q, v, a, tau


@pytest.mark.slow
@pytest.mark.parametrize("bodies", [(), "all"])
def test_least_squares_of_exact_motion_returns_the_robot(described, bodies):
    path = described(robots.urdf(parents=(0, 1)))
    model = dr.models.robot(path, bodies=bodies)
    t, q, v, a, tau = moved(path, 2, friction=0.2)
    names = list(model.coordinates)
    signals = {n: q[:, k] for k, n in enumerate(names)} | {f"{n}_dot": v[:, k] for k, n in enumerate(names)}
    signals |= {f"{n}_ddot": a[:, k] for k, n in enumerate(names)}
    log = dr.Log.from_arrays(t, signals | {f"{n}_torque": tau[:, k] for k, n in enumerate(names)})
    result = dr.identify(model, log, "ols")
    assert dict(result.parameters) == pytest.approx({n: x.value for n, x in model.parameters.items()}, abs=1e-8)


# ---------------------------------------------------------------------- positions of bodies


@EVERY_ROBOT
def test_points_of_bodies_are_where_mujoco_has_them(described, kind):
    path = described(ROBOTS[kind](1))
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.fusestatic = False  # links of URDF on fixed joints remain
    model = spec.compile()
    data = mujoco.MjData(model)
    joints = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, k) for k in range(model.njnt)]
    point = np.array([0.03, -0.2, 0.1])
    for body, coordinates in dr.models.coordinates_of_bodies(path).items():
        outputs = dr.models.body_position(path, body, point)
        i = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body)
        for q in np.random.default_rng(2).normal(size=(3, model.nq)):
            data.qpos[:] = q
            mujoco.mj_kinematics(model, data)
            named = {robots_identifier(name): x for name, x in zip(joints, q, strict=True)}
            found = outputs(named, None, None, None, None)
            expected = data.xpos[i] + data.xmat[i].reshape(3, 3) @ point
            assert [float(x) for x in found.values()] == pytest.approx(expected, abs=EXACT)
            assert set(coordinates) <= set(named)


def test_a_body_behind_a_coupled_joint_is_moved_by_its_leader(described):
    path = described(robots.panda_like())
    assert dr.models.coordinates_of_bodies(path)["right"][-1] == "left_finger"
    model, data = compiled(path)
    i = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "right")
    q = np.append(np.linspace(-0.5, 0.6, 7), [0.02, 0.021])  # right_finger = 0.001 + left_finger
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    named = dict(zip((*(f"joint{k}" for k in range(1, 8)), "left_finger"), q, strict=False))
    found = dr.models.body_position(path, "right")(named, None, None, None, None)
    assert [float(x) for x in found.values()] == pytest.approx(data.xpos[i], abs=EXACT)
    assert list(found) == ["right_x", "right_y", "right_z"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"body": "foot"}, "body: there is no 'foot'"),
        ({"body": "hand", "point": (0.0, 1.0)}, "point is"),
        ({"body": "hand", "joints": "joint9"}, "joints: there is no 'joint9'"),
    ],
)
def test_positions_of_no_body_are_refused(described, words, message):
    with pytest.raises(ModelError, match=message):
        dr.models.body_position(described(robots.panda_like()), **words)
