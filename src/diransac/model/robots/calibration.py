"""Estimates in a robot's description file: the same text but for the values that were identified."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError
from diransac.model.parameter import Parameter
from diransac.model.robots.consistency import consistent_parameters, inconsistency
from diransac.model.robots.description import Description, Joint, read_description
from diransac.model.robots.inertias import with_unknown
from diransac.model.robots.rigid_body import INERTIAL_NAMES, inertial_parameters


def calibrated(
    path: str | Path, parameters: Mapping[str, Parameter], values: FloatArray, covariance: FloatArray
) -> tuple[str, tuple[str, ...]]:
    """Text of a description with estimates in it, and the parameters that are not in it.

    Parameters of joints replace those of the file. Inertials are the physically consistent ones nearest to those of the
    file, of all that explain the estimated base parameters (`consistent_parameters`).

    Parameters
    ----------
    path : str or Path
        MJCF or URDF file, for which `robot` made the model.
    parameters : mapping of str to Parameter
        Those of the model.
    values, covariance : (n_p,), (n_p, n_p) arrays
        Estimates of them; NaN where there is none.

    Returns
    -------
    text : str
        The file's, comments and layout included.
    left_out : tuple of str
        Parameters that are not in the text: there is no estimate, or the format cannot express them, such as the bias
        of an encoder.

    Raises
    ------
    ModelError
        The file cannot be read; a joint or body is not in it, but in one that it includes; the parameters are not those
        of a robot.
    """
    description = read_description(path, "held")
    source = Path(path).read_bytes()
    of_joints, of_bodies = _estimates(description, parameters, values, covariance)
    document = Document(source, f'robot description "{path}"')
    # Attributes of a joint, and of a URDF joint's dynamics, by parameter.
    of_mjcf = {"armature": "armature", "damping": "damping", "friction": "frictionloss", "spring": "stiffness"}
    attributes = {"damping": "damping", "friction": "friction"} if document.is_urdf else of_mjcf
    texts, placed = dict[str, dict[str, float]](), set[str]()
    for place, value in of_joints.items():
        kind, _, name = place.partition(" ")
        own = texts.setdefault(name, {})
        if kind in attributes:
            own[attributes[kind]] = value
            placed.add(place)
    joints = {x.name: x for x in description.joints}
    for name, own in texts.items():
        if name not in joints:
            raise ModelError(f'there is no joint "{name}" in the description')
        document.set_joint(joints[name], own)
    for name, inertial in of_bodies.items():
        document.set_body(name, inertial)
    left_out = [
        n
        for (n, x), value in zip(parameters.items(), values, strict=True)
        if np.isnan(value) or not (_has_inertials(dict(x.combination)) or x.combination[0][0] in placed)
    ]
    return document.text(), tuple(left_out)


def impossible_changes(
    parameters: Mapping[str, Parameter], values: FloatArray, covariance: FloatArray
) -> dict[str, float]:
    """Least changes of estimated base parameters by which they are those of possible bodies, over standard errors.

    Parameters
    ----------
    parameters : mapping of str to Parameter
    values, covariance : (n_p,), (n_p, n_p) arrays
        Estimates of them; parameters of infinite variance are left out.

    Returns
    -------
    dict of str to float
        Empty where no parameter is one of a body.
    """
    places = {n: dict(x.combination) for n, x in parameters.items()}
    spread = np.diag(covariance)
    known = [
        k for k, n in enumerate(places) if _has_inertials(places[n]) and np.isfinite(spread[k]) and spread[k] > 0.0
    ]
    if not known:
        return {}
    names = [list(places)[k] for k in known]
    bodies, _, combinations = _combinations([places[n] for n in names])
    changes = inconsistency(combinations, len(bodies), values[known], covariance[np.ix_(known, known)])
    return dict(zip(names, changes.tolist(), strict=True))


# ---------------------------------------------------------------------- values


def _estimates(
    description: Description, parameters: Mapping[str, Parameter], values: FloatArray, covariance: FloatArray
) -> tuple[dict[str, float], dict[str, FloatArray]]:
    """Parameters of joints by place, such as ``armature elbow``, and the ten inertial parameters of bodies by name."""
    places = {n: dict(x.combination) for n, x in parameters.items()}
    if not all(places.values()):
        raise ModelError(f"{next(n for n, x in places.items() if not x)} is no parameter of a robot's description")
    of_joints, known = dict[str, float](), list[int]()
    for k, own in enumerate(places.values()):
        if not np.isnan(values[k]):
            if not _has_inertials(own):
                of_joints[next(iter(own))] = float(values[k])
            elif np.isfinite(covariance[k, k]):
                known.append(k)
    if not known:
        return of_joints, {}
    every = list(places.values())
    names, constants, combinations = _combinations([every[k] for k in known])
    description = with_unknown(description, [i for i, x in enumerate(description.bodies) if x.name in names])
    bodies, joints = {x.name: x for x in description.bodies}, {x.name: x for x in description.joints}
    missing = [name for name in names if name not in bodies]
    if missing:
        raise ModelError(f'there is no body "{missing[0]}" in the description')
    inertials, others = consistent_parameters(
        np.array([inertial_parameters(bodies[name].inertial) for name in names]),
        np.array([joints[place.partition(" ")[2]].armature for place in constants]),
        combinations,
        values[known],
        covariance[np.ix_(known, known)],
    )
    return of_joints | dict(zip(constants, others.tolist(), strict=True)), dict(zip(names, inertials, strict=True))


def _has_inertials(places: Mapping[str, float]) -> bool:
    return any(place.partition(" ")[0] in INERTIAL_NAMES for place in places)


def _combinations(places: list[dict[str, float]]) -> tuple[list[str], list[str], FloatArray]:
    """Bodies, constants of joints, and the matrix by which the parameters of both give base parameters."""
    every = list(dict.fromkeys(place for own in places for place in own))
    of_bodies = [place for place in every if place.partition(" ")[0] in INERTIAL_NAMES]
    bodies = list(dict.fromkeys(place.partition(" ")[2] for place in of_bodies))
    constants = [place for place in every if place not in of_bodies]
    columns = [f"{kind} {body}" for body in bodies for kind in INERTIAL_NAMES] + constants
    return bodies, constants, np.array([[own.get(column, 0.0) for column in columns] for own in places])


# ---------------------------------------------------------------------- text


@dataclass
class Element:
    """Place of an element in the text, in bytes: of its start tag, and of the element."""

    tag: str
    attributes: dict[str, str]
    begin: int
    inside: int
    end: int
    children: list[Element]


class Document:
    """Text of a description, in which elements are replaced."""

    def __init__(self, source: bytes, label: str) -> None:
        self.source, self.label = source, label
        self.root = _elements(source)
        self.is_urdf = self.root.tag == "robot"
        self.changes = dict[tuple[int, int], str]()

    def text(self) -> str:
        """The text with all changes."""
        parts, at = list[bytes](), 0
        for (begin, end), new in sorted(self.changes.items()):
            parts += [self.source[at:begin], new.encode()]
            at = end
        return b"".join([*parts, self.source[at:]]).decode()

    def set_joint(self, joint: Joint, values: Mapping[str, float]) -> None:
        """Give a joint these attributes; those of a URDF belong to its dynamics."""
        element = self.named("joint", joint.name)
        texts = {key: repr(value) for key, value in values.items()}
        for key, polynomial in (("damping", joint.damping), ("stiffness", joint.stiffness)):
            if key in texts and len(polynomial) > 1:
                texts[key] = " ".join([texts[key], *map(repr, polynomial[1:])])
        if not self.is_urdf:
            self.rewrite(element, texts)
        elif dynamics := [x for x in element.children if x.tag == "dynamics"]:
            self.rewrite(dynamics[0], texts)
        elif texts:
            self.insert(element, f"<dynamics {attributes(texts)}/>")

    def set_body(self, name: str, inertial: FloatArray) -> None:
        """Give a body these inertial parameters about the origin of its frame."""
        element = self.named("link" if self.is_urdf else "body", name)
        mass, h = inertial[0], inertial[1:4]
        centre = h / mass
        shift = mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        about_centre = inertial[4:] - np.array([*np.diag(shift), shift[0, 1], shift[0, 2], shift[1, 2]])
        new = (_urdf_inertial if self.is_urdf else _mjcf_inertial)(float(mass), centre, about_centre)
        if old := [x for x in element.children if x.tag == "inertial"]:
            self.changes[old[0].begin, old[0].end] = new
        else:
            self.insert(element, new)

    def named(self, tag: str, name: str, section: str = "worldbody") -> Element:
        """The body, link or joint of a name, or any element of another section.  Raises ModelError: there is none."""
        parents = [self.root] if self.is_urdf else [x for x in self.root.children if x.tag == section]
        for element in (x for parent in parents for x in _below(parent)):
            fits = section != "worldbody" or element.tag == tag
            if fits and element.attributes.get("name") == name:
                return element
        raise ModelError(
            f'{self.label}: {tag} "{name}" is not in this file by name; write the files that it includes into one'
        )

    def rewrite(self, element: Element, texts: Mapping[str, str]) -> None:
        """Replace or add attributes in a start tag."""
        place = element.begin, element.inside
        tag = self.changes.get(place, self.source[slice(*place)].decode())
        for key, text in texts.items():
            tag, count = re.subn(rf"(\s{key}\s*=\s*)(\"[^\"]*\"|'[^']*')", rf'\g<1>"{text}"', tag, count=1)
            if not count:
                tag = re.sub(r"\s*(/?>)$", rf' {key}="{text}"\g<1>', tag)
        self.changes[place] = tag

    def insert(self, element: Element, new: str) -> None:
        """Add a first child."""
        start = self.source[element.begin : element.inside].decode()
        if start.endswith("/>"):
            place = element.begin, element.inside
            self.changes[place] = f"{self.changes.get(place, start)[:-2].rstrip()}>{new}</{element.tag}>"
        else:
            place = element.inside, element.inside
            self.changes[place] = self.changes.get(place, "") + new


def _elements(source: bytes) -> Element:
    """The root element, with all below it."""
    parser, open_elements, roots = expat.ParserCreate(), list[Element](), list[Element]()

    def start(tag: str, attributes: dict[str, str]) -> None:
        begin = parser.CurrentByteIndex
        inside = _end_of_tag(source, begin)
        element = Element(tag, attributes, begin, inside, inside, [])
        (open_elements[-1].children if open_elements else roots).append(element)
        open_elements.append(element)

    def end(_tag: str) -> None:
        element, at = open_elements.pop(), parser.CurrentByteIndex
        if source[element.inside - 2 : element.inside] != b"/>":
            element.end = source.index(b">", at) + 1

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(source, True)
    return roots[0]


def _end_of_tag(source: bytes, begin: int) -> int:
    """Index behind a start tag, whose attributes may contain ``>``."""
    match = re.compile(rb"<[^\s/>]+(?:\s+[^\s=]+\s*=\s*(?:\"[^\"]*\"|'[^']*'))*\s*/?>").match(source, begin)
    assert match is not None
    return match.end()


def _below(element: Element) -> Iterator[Element]:
    """Elements below one, in order."""
    for child in element.children:
        yield child
        yield from _below(child)


def attributes(texts: Mapping[str, str]) -> str:
    """Attributes of an element."""
    return " ".join(f"{key}={quoteattr(text)}" for key, text in texts.items())


def numbers(values: FloatArray) -> str:
    """Numbers with all of their digits."""
    return " ".join(repr(float(x)) for x in np.ravel(values))


def _mjcf_inertial(mass: float, centre: FloatArray, inertia: FloatArray) -> str:
    """Element of a body, with the inertia about the centre of mass, xx yy zz xy xz yz."""
    return f'<inertial pos="{numbers(centre)}" mass="{mass!r}" fullinertia="{numbers(inertia)}"/>'


def _urdf_inertial(mass: float, centre: FloatArray, inertia: FloatArray) -> str:
    """Element of a link, with the inertia about the centre of mass, xx yy zz xy xz yz."""
    entries = zip(("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), inertia.tolist(), strict=True)
    return (
        f'<inertial><origin xyz="{numbers(centre)}" rpy="0 0 0"/><mass value="{mass!r}"/>'
        f"<inertia {attributes({key: repr(x) for key, x in entries})}/></inertial>"
    )
