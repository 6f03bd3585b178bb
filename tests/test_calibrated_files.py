"""Calibrated files: MuJoCo compiles them to what was identified, whatever its compiler does, or they are refused."""

from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from diransac.errors import ModelError
from diransac.model.mjcf import calibrated_text
from diransac.model.robots.calibration import calibrated

mujoco = pytest.importorskip("mujoco", reason="CALIBRATED FILES NOT CHECKED: mujoco is missing")
VERSION = tuple(int(x) for x in mujoco.__version__.split(".")[:2])

LINK = '<inertial pos="0 0 -.2" mass="1" diaginertia=".01 .02 .015"/>'
JOINT = '<joint name="j" axis="0 1 0" damping="0.1" armature="0.01" stiffness="1" springref="10"/>'


def pendulum(compiler="", joint=JOINT, link=LINK, around=("", "")):
    body = f'<body name="b">{joint}{link}</body>'
    return f"<mujoco><compiler {compiler}/><worldbody>{around[0]}{body}{around[1]}</worldbody></mujoco>"


AUDIT = {
    "polynomials": pendulum(joint=JOINT.replace("0.1", "0.1 0.05").replace('"1"', '"1 0 0.2"')),
    "total mass": pendulum('settotalmass="1"'),
    "inertia of shapes": pendulum('inertiafromgeom="true"', link='<geom size=".05" pos="0 0 -.2" mass="1"/>'),
    "scaled frame": pendulum(around=('<frame scale="2">', "</frame>")),
    "stretched frame": pendulum(around=('<frame scale="2 2 2" massscale="3">', "</frame>")),
    "bounds": pendulum('boundmass="1.7" boundinertia="0.05"'),
    "spring and damper": pendulum(joint=JOINT.replace('stiffness="1"', 'springdamper="0.2 0.3"')),
}
NEWER = {"polynomials": (3, 7), "scaled frame": (3, 16), "stretched frame": (3, 16)}


@pytest.fixture(params=list(AUDIT))
def described(request, tmp_path) -> Path:
    """File whose compiler undoes, multiplies or drops what is written."""
    if NEWER.get(request.param, (0, 0)) > VERSION:
        pytest.skip(f"{request.param.upper()} NOT CHECKED: MuJoCo is older")
    path = tmp_path / "robot.xml"
    path.write_text(AUDIT[request.param])
    return path


def tensors(model):
    """Inertias of bodies in their frames ``(n, 3, 3)``, kg m^2."""
    axes = np.empty((model.nbody, 9))
    for k, quaternion in enumerate(model.body_iquat):
        mujoco.mju_quat2Mat(axes[k], quaternion)
    axes = axes.reshape(-1, 3, 3)
    return np.einsum("bik,bk,bjk->bij", axes, model.body_inertia, axes)


def assert_same(found, meant, relative=1e-9):
    """Two compiled models have the same bodies, joints and actuators, and the same forces at random."""
    arrays = ["body_mass", "body_ipos", "body_pos", "body_quat", "qpos0", "qpos_spring", "jnt_pos", "jnt_axis"]
    arrays += ["geom_pos", "geom_size", "geom_friction", "jnt_range", "actuator_gear", "actuator_ctrlrange"]
    arrays += [
        x for x in dir(meant) if x.startswith(("dof_", "jnt_", "actuator_")) and x.endswith(("ing", "poly", "prm"))
    ]
    arrays += ["dof_armature", "dof_frictionloss", "jnt_stiffness", "actuator_gaintype", "actuator_biastype"]
    for name in arrays:
        own, theirs = getattr(found, name), getattr(meant, name)
        np.testing.assert_allclose(own, theirs, rtol=relative, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(tensors(found), tensors(meant), rtol=relative, atol=relative * meant.body_inertia.max())
    np.testing.assert_allclose(forces(found), forces(meant), rtol=1e-6, atol=1e-8 * np.abs(forces(meant)).max())


def forces(model):
    """Inverse dynamics, and forces of actuators, at random states."""
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.body_sameframe[:], model.body_simple[:], model.dof_simplenum[:] = 0, 0, 0
    data, rows, rng = mujoco.MjData(model), [], np.random.default_rng(0)
    for q, v, a in rng.normal(size=(5, 3, model.nv)):
        data.qpos[:], data.qvel[:], data.qacc[:], data.ctrl[:] = q, v, a, 0.1
        mujoco.mj_inverse(model, data)
        inverse = data.qfrc_inverse.copy()
        mujoco.mj_forward(model, data)
        rows += [inverse, data.qfrc_actuator.copy()]
    return np.array(rows)


def test_masks_are_what_the_written_file_compiles_to(described):
    fields = ("body/b.mass", "body/b.inertia", "joint/j.damping", "joint/j.stiffness", "joint/j.springref")
    model = dr.models.mujoco(described, unknown=fields)
    meant = mujoco.MjModel.from_xml_path(str(described))
    meant.body_mass[1], meant.body_inertia[1] = 1.5, (0.02, 0.03, 0.025)
    meant.dof_damping[0], meant.jnt_stiffness[0], meant.qpos_spring[0] = 4.8, 2.0, 0.3
    values = dict(zip(model.parameters, (1.5, 0.02, 0.03, 0.025, 4.8, 2.0, 0.3), strict=True))
    text, left_out = calibrated_text(described, model, values, 1e-6 * np.eye(7))
    assert left_out == ()
    assert_same(mujoco.MjModel.from_xml_string(text), meant)


def test_parameters_of_a_robot_are_what_the_written_file_compiles_to(described):
    model = dr.models.robot(described, unknown=("armature", "damping", "spring"), bodies="all")
    values = np.array([1.5 * x.value for x in model.parameters.values()])
    text, left_out = calibrated(described, model.parameters, values, np.diag((1e-6 * np.abs(values) + 1e-9) ** 2))
    assert left_out == ()
    found, meant = mujoco.MjModel.from_xml_string(text), mujoco.MjModel.from_xml_path(str(described))
    for array in (meant.body_mass, meant.body_inertia, meant.dof_armature, meant.dof_damping, meant.jnt_stiffness):
        array *= 1.5
    expected = forces(meant)
    assert forces(found) == pytest.approx(expected, abs=1e-4 * np.abs(expected).max())
    again = tmp_robot(described, text)
    assert [x.value for x in again.parameters.values()] == pytest.approx(values, rel=1e-4)


def tmp_robot(path, text):
    """Model of a text that stands beside a file."""
    other = path.with_name("calibrated.xml")
    other.write_text(text)
    return dr.models.robot(other, unknown=("armature", "damping", "spring"), bodies="all")


def test_other_bodies_keep_the_inertials_that_the_total_mass_gave_them(tmp_path):
    path = tmp_path / "robot.xml"
    second = '<body><joint axis="0 1 0"/><geom size="0.1" pos="0 0 -.3"/></body></body>'
    path.write_text(pendulum('settotalmass="3"').replace("</body>", second))
    before = mujoco.MjModel.from_xml_path(str(path))
    model = dr.models.mujoco(path, unknown=["body/b.mass"])
    found = mujoco.MjModel.from_xml_string(calibrated_text(path, model, {"body/b.mass": 0.4}, np.eye(1))[0])
    assert found.body_mass.tolist() == [0.0, 0.4, before.body_mass[2]]
    np.testing.assert_allclose(found.body_inertia[2], before.body_inertia[2], rtol=1e-12)


@pytest.mark.skipif(VERSION < (3, 7), reason="ACTUATORS' ARMATURE NOT CHECKED: MuJoCo is older")
def test_armature_of_an_actuator_is_not_written_twice(tmp_path):
    path = tmp_path / "robot.xml"
    drive = '<actuator><motor name="m" joint="j" gear="10" armature="0.0005" damping="0.001"/></actuator></mujoco>'
    path.write_text(pendulum().replace("</mujoco>", drive))
    model = dr.models.robot(path, unknown=("armature", "damping"))
    found = mujoco.MjModel.from_xml_string(calibrated(path, model.parameters, np.array([0.08, 0.3]), np.eye(2))[0])
    data = mujoco.MjData(found)
    mujoco.mj_forward(found, data)
    assert found.dof_armature[0] + 10.0**2 * found.actuator_armature[0] == pytest.approx(0.08)
    assert found.dof_damping[0] + 10.0**2 * found.actuator_damping[0] == pytest.approx(0.3)
    with pytest.raises(ModelError, match=r'armature of joint "j" is 0.03, but its actuators alone have 0.05'):
        calibrated(path, model.parameters, np.array([0.03, 0.3]), np.eye(2))


MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def test_other_files_are_those_of_the_descriptions_folder_and_nothing_is_left_there(tmp_path, monkeypatch):
    folder = tmp_path / "models" / "parts"
    folder.mkdir(parents=True)
    (tmp_path / "models" / "meshes").mkdir()
    (tmp_path / "models" / "meshes" / "a.obj").write_text(MESH)
    (folder / "robot.xml").write_text('<mujocoinclude><site name="s" pos="1 2 3"/></mujocoinclude>')
    path = tmp_path / "models" / "robot.xml"
    asset = '<asset><mesh name="a" file="a.obj"/></asset><worldbody>'
    link = '<geom type="mesh" mesh="a" mass="1"/><include file="parts/robot.xml"/>'
    path.write_text(pendulum('meshdir="meshes"', link=link).replace("<worldbody>", asset))
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(folder)
    relative = Path("../robot.xml")
    robot = dr.models.robot(relative, unknown=("damping",))
    text = calibrated(relative, robot.parameters, np.array([0.7]), np.eye(1))[0]
    assert text == path.read_text().replace('damping="0.1"', 'damping="0.7"')
    model = dr.models.mujoco(relative, unknown=["joint/j.damping"])
    assert calibrated_text(relative, model, {"joint/j.damping": 0.7}, np.eye(1))[0] == text
    assert sorted(tmp_path.rglob("*")) == before


def test_meshes_of_a_robot_need_not_be_there(tmp_path):
    path = tmp_path / "robot.xml"
    asset = '<asset><mesh name="a" file="nowhere.obj"/></asset><worldbody>'
    path.write_text(pendulum(link=f'<geom type="mesh" mesh="a"/>{LINK}').replace("<worldbody>", asset))
    model = dr.models.robot(path, unknown=("damping",))
    text = calibrated(path, model.parameters, np.array([0.7]), np.eye(1))[0]
    assert text == path.read_text().replace('damping="0.1"', 'damping="0.7"')


@pytest.mark.parametrize(
    ("text", "mask", "said"),
    [
        (
            pendulum(around=('<frame pos="1 0 0" euler="0 0 90">', "</frame>")),
            "body/b.pos[0]",
            'pos of body "b" is to be 3, but MuJoCo compiles what is written to',
        ),
        (
            pendulum().replace("<worldbody>", '<worldbody><replicate count="2" offset="1 0 0">')
            .replace("</worldbody>", "</replicate></worldbody>"),
            "body/b0.mass",
            'body "b0" is not in this file by name',
        ),
    ],
)  # fmt: skip
def test_what_does_not_come_back_is_refused_by_name(tmp_path, text, mask, said):
    path = tmp_path / "robot.xml"
    path.write_text(text)
    model = dr.models.mujoco(path, unknown=[mask])
    with pytest.raises(ModelError, match=said):
        calibrated_text(path, model, {mask: 3.0}, np.eye(1))


# ---------------------------------------------------------------------- random files


def random_file(rng):
    """Chain of three links in a file with some features of MuJoCo's compiler."""

    def some(*choices):
        return str(rng.choice(choices))

    scaled = VERSION >= (3, 16)
    compiler = [
        some("", f'settotalmass="{rng.uniform(1.0, 9.0):.3f}"'),
        some("", 'inertiafromgeom="true"', 'inertiafromgeom="auto"'),
        some("", 'boundmass="0.9"', 'boundinertia="0.02"'),
        some("", 'balanceinertia="true"'),
        some("", 'angle="radian"', 'angle="degree"'),
        some("", 'eulerseq="zyx"', 'eulerseq="XYZ"'),
        some("", 'autolimits="true"'),
    ]
    poly = some(" 0.03", " 0.02 0.01", "") if VERSION >= (3, 7) else ""
    spring = some(f'stiffness="2{poly}"', "", 'springdamper="0.2 0.4"')
    defaults = (
        f'<default><joint damping="0.2{poly}" {spring}/><default class="strong"><joint armature="0.05" stiffness="7"/>'
        '<position kp="3" dampratio="0.7"/></default></default>'
    )
    parts, closing = [], []
    for k in range(3):
        frame = some("", 'pos="0.1 0 0.2" euler="10 20 0"', f'scale="{rng.uniform(0.6, 1.8):.3f}"' if scaled else "")
        parts.append(f"<frame {frame}>")
        parts.append(f'<body name="b{k}" pos="0 0.1 -0.3" euler="5 0 {k}" {some("", "childclass=" + repr("strong"))}>')
        of_joint = [
            some("", 'armature="0.02"'),
            some("", 'springref="0.3"'),
            some("", 'range="-1 1"'),
            some("", 'class="strong"'),
        ]
        parts.append(f'<joint name="j{k}" axis="{some("0 1 0", "1 0 0")}" frictionloss="0.1" {" ".join(of_joint)}/>')
        shape = f'<geom type="box" size="0.05 0.1 {rng.uniform(0.05, 0.2):.3f}" pos="0 0.02 -0.1"/>'
        given = (
            f'<inertial pos="0.01 0 -.1" mass="{rng.uniform(0.3, 2.0):.3f}" diaginertia=".03 .02 .025" euler="3 4 5"/>'
        )
        parts.append(some(shape, shape + given))
        closing.append("</body></frame>")
    drives = [
        some(
            "motor",
            'position kp="30" dampratio="1"',
            'position kp="30" kv="2"',
            'position class="strong"',
            'velocity kv="2"',
        )
        for _ in range(3)
    ]
    actuators = "".join(f'<{x} name="a{k}" joint="j{k}" gear="{k + 1}"/>' for k, x in enumerate(drives))
    return (
        f"<mujoco><compiler {' '.join(compiler)}/>{defaults}<worldbody>{''.join(parts)}{''.join(closing)}</worldbody>"
        f"<actuator>{actuators}</actuator></mujoco>"
    )


@pytest.mark.parametrize("seed", range(40))
def test_random_files_compile_to_what_was_written_or_are_refused_by_name(tmp_path, seed):
    rng, path = np.random.default_rng(seed), tmp_path / "robot.xml"
    path.write_text(random_file(rng))
    meant = mujoco.MjModel.from_xml_path(str(path))
    scales = rng.uniform(0.5, 1.8, 7)
    joint, body = f"j{rng.integers(3)}", f"b{rng.integers(3)}"
    j, b = meant.joint(joint).id, meant.body(body).id
    masks = [f"joint/{joint}.{x}" for x in ("armature", "damping", "frictionloss", "stiffness")] + [f"body/{body}.mass"]
    model = dr.models.mujoco(path, unknown=[*masks, f"joint/{joint}.springref", f"body/{body}.ipos[2]"])
    arrays = [meant.dof_armature, meant.dof_damping, meant.dof_frictionloss, meant.jnt_stiffness, meant.body_mass]
    places = list(zip([*arrays, meant.qpos_spring, meant.body_ipos[:, 2]], [j, j, j, j, b, j, b], strict=True))
    for (array, k), scale, parameter in zip(places, scales, model.parameters.values(), strict=True):
        assert parameter.value == pytest.approx(array[k], rel=1e-5)
        array[k] *= scale
    values = dict(zip(model.parameters, [float(array[k]) for array, k in places], strict=True))
    text, left_out = calibrated_text(path, model, values, np.eye(7))
    assert left_out == ()
    found = mujoco.MjModel.from_xml_string(text)
    assert_same(found, meant)


@pytest.mark.parametrize("seed", range(100, 120))
def test_random_files_of_robots_compile_to_what_was_identified(tmp_path, seed):
    rng, path = np.random.default_rng(seed), tmp_path / "robot.xml"
    path.write_text(random_file(rng))
    scale = rng.uniform(0.6, 1.7)
    model = dr.models.robot(path, unknown=("armature", "damping", "friction"), bodies="all")
    values = np.array([scale * x.value for x in model.parameters.values()])
    text, _ = calibrated(path, model.parameters, values, np.diag((1e-6 * np.abs(values) + 1e-9) ** 2))
    found, meant = mujoco.MjModel.from_xml_string(text), mujoco.MjModel.from_xml_path(str(path))
    for array in (meant.body_mass, meant.body_inertia, meant.dof_armature, meant.dof_damping, meant.dof_frictionloss):
        array *= scale
    expected = forces(meant)
    assert forces(found) == pytest.approx(expected, abs=1e-3 * np.abs(expected).max())
    for name in ("actuator_gainprm", "actuator_biasprm", "dof_damping", "dof_frictionloss"):
        np.testing.assert_allclose(getattr(found, name), getattr(meant, name), rtol=1e-9)
