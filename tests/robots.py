"""Descriptions of robots with random inertials: an arm with a gripper, a quadruped, and arms and trees in URDF."""

import numpy as np


def inertial(rng, scale=1.0):
    """Mass, centre and inertia about it (3, 3) of a random rigid body."""
    mass = scale * rng.uniform(0.5, 3.0)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    second_moments = mass * rng.uniform(0.02, 0.15, 3) ** 2
    inertia = axes @ np.diag(second_moments.sum() - second_moments) @ axes.T
    return mass, rng.uniform(-0.1, 0.1, 3), inertia


def text(values):
    """Numbers with all their digits."""
    return " ".join(repr(float(x)) for x in np.ravel(values))


def mjcf_inertial(rng, scale=1.0):
    mass, centre, I = inertial(rng, scale)
    full = I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]
    return f'<inertial mass="{mass!r}" pos="{text(centre)}" fullinertia="{text(full)}"/>'


def panda_like(seed=0, couplings=True):
    """Seven hinges and a hand with two coupled fingers: MJCF."""
    rng = np.random.default_rng(seed)
    offsets = [(0, 0, 0.333), (0, 0, 0), (0, -0.316, 0), (0.0825, 0, 0), (-0.0825, 0.384, 0), (0, 0, 0), (0.088, 0, 0)]
    turns = ["1 0 0 0", "1 -1 0 0", "1 1 0 0", "1 1 0 0", "1 -1 0 0", "1 1 0 0", "1 1 0 0"]
    parts = [f'<mujoco model="arm"><compiler angle="radian"/><worldbody><body name="link0">{mjcf_inertial(rng)}']
    for k, (offset, turn) in enumerate(zip(offsets, turns, strict=True), 1):
        parts.append(f'<body name="link{k}" pos="{text(offset)}" quat="{turn}">{mjcf_inertial(rng)}')
        of_joint = f'armature="{rng.uniform(0.05, 0.2)!r}" damping="{rng.uniform(0.1, 1.0)!r}" frictionloss="0.3"'
        parts.append(f'<joint name="joint{k}" axis="0 0 1" range="-2.9 2.9" {of_joint}/>')
    parts.append(f'<body name="hand" pos="0 0 0.107" quat="0.92 0 0 -0.38">{mjcf_inertial(rng, 0.3)}')
    for side, sign in (("left", 1), ("right", -1)):
        parts.append(f'<body name="{side}" pos="0 0 0.0584">{mjcf_inertial(rng, 0.05)}')
        parts.append(
            f'<joint name="{side}_finger" type="slide" axis="0 {sign} 0" range="0 0.04" armature="0.1"/></body>'
        )
    equality = '<joint joint1="right_finger" joint2="left_finger" polycoef="0.001 1 0 0 0"/>' if couplings else ""
    return "".join([*parts, "</body>", "</body>" * 8, f"</worldbody><equality>{equality}</equality></mujoco>"])


def quadruped(seed=0, base="", legs=("FL", "FR", "RL", "RR")):
    """Four legs of three hinges, or some of them: MJCF."""
    rng = np.random.default_rng(seed)
    parts = ['<mujoco model="quadruped"><compiler angle="radian"/><worldbody>']
    parts.append(f'<body name="trunk" pos="0 0 0.5">{mjcf_inertial(rng, 4.0)}{base}')
    for leg in legs:
        x, y = (1 if leg[0] == "F" else -1), (1 if leg[1] == "L" else -1)
        places = [(0.19 * x, 0.05 * y, 0), (0, 0.09 * y, 0), (0, 0, -0.21)]
        for part, place, axis in zip(("hip", "thigh", "calf"), places, ("1 0 0", "0 1 0", "0 1 0"), strict=True):
            parts.append(f'<body name="{leg}_{part}" pos="{text(place)}">{mjcf_inertial(rng, 0.3)}')
            parts.append(
                f'<joint name="{leg}_{part}_joint" axis="{axis}" armature="0.01" damping="0.2" frictionloss="0.1"/>'
            )
        parts.append("</body>" * 3)
    return "".join([*parts, "</body></worldbody></mujoco>"])


def unusual(seed=0):
    """Several joints on a body, anchors, references, springs, polynomials, compensated weight, tilted gravity: MJCF."""
    rng = np.random.default_rng(seed)
    return f"""<mujoco model="unusual"><compiler angle="radian"/><option gravity="1 2 -9"/><worldbody>
      <body name="cross" pos=".1 .2 .3" euler=".3 .2 .1">{mjcf_inertial(rng)}
        <joint name="a" pos=".1 .2 .3" axis="1 2 3" ref=".3" armature=".1" stiffness="2" springref=".2"/>
        <joint name="b" type="slide" axis="1 0 2" pos="1 2 3" ref="-.2" damping=".3"/>
        <joint name="c" axis="0 1 0" pos="-.1 0 .2"/>
        <body name="plate" pos=".1 .2 .3" euler=".4 .5 .6" gravcomp=".7">{mjcf_inertial(rng)}
          <body name="bracket" pos=".1 0 .3" euler=".4 0 .6" gravcomp=".7">{mjcf_inertial(rng)}
            <body name="tip" pos="0 0 .2">{mjcf_inertial(rng)}<joint name="d" pos="0 .1 0" damping="1"/></body>
          </body></body>
        <body name="side" pos=".5 0 0" gravcomp="1">{mjcf_inertial(rng)}
          <joint name="e" type="slide" axis="0 1 0" stiffness="3"/><joint name="f" axis="0 0 1" pos=".3 .2 .1"/></body>
      </body></worldbody></mujoco>"""


def urdf(seed=0, parents=(0, 1, 2, 3, 4, 5), kinds=None, mesh=False, inertials=0):
    """Tree of links, each on one of those before it (0: the base), with a tool on the last: URDF."""
    rng, of_links = np.random.default_rng(seed), np.random.default_rng((seed, inertials))
    kinds = kinds or ["revolute"] * len(parents)
    shape = '<visual><geometry><mesh filename="package://arm/link.stl"/></geometry></visual>' if mesh else ""
    parts = ['<robot name="six axes"><link name="link0"/>']
    links = [*((f"link{k}", 1.0) for k in range(1, len(parents) + 1)), ("tool", 0.3)]
    for name, scale in links:
        mass, centre, I = inertial(of_links, scale)
        entries = {"ixx": I[0, 0], "iyy": I[1, 1], "izz": I[2, 2], "ixy": I[0, 1], "ixz": I[0, 2], "iyz": I[1, 2]}
        values = " ".join(f'{key}="{float(x)!r}"' for key, x in entries.items())
        parts.append(f'<link name="{name}">{shape}<inertial><origin xyz="{text(centre)}"/><mass value="{mass!r}"/>')
        parts.append(f"<inertia {values}/></inertial></link>")
    joints = [*zip(parents, kinds, (name for name, _ in links), strict=False), (len(parents), "fixed", "tool")]
    for k, (parent, kind, child) in enumerate(joints, 1):
        axis = rng.normal(size=3)
        parts.append(
            f'<joint name="joint-{k}" type="{kind}"><parent link="link{parent}"/><child link="{child}"/>'
            f'<origin xyz="{text(rng.uniform(-0.3, 0.3, 3))}" rpy="{text(rng.uniform(-1, 1, 3))}"/>'
            f'<axis xyz="{text(axis / np.linalg.norm(axis))}"/><limit lower="-3" upper="3" effort="90" velocity="3"/>'
            '<dynamics damping="0.4" friction="0.2"/></joint>'
        )
    return "".join([*parts, "</robot>"])
