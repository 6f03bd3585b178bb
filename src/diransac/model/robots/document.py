"""Text of a description, in which elements are rewritten and all else stays as it is."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike

from diransac.errors import ModelError

_SECTIONS = {"actuator": "actuator", "tendon": "tendon", "equality": "equality", "pair": "contact"}
"""Sections of an MJCF by kind of element; elements of all other kinds are in bodies."""


@dataclass
class Element:
    """Element of the text, and what is to stand there.

    Parameters
    ----------
    tag : str
    attributes : dict of str to str
        Those of the text.
    begin, inside, end : int
        Place in the text, in bytes: of its start tag, and of the element; equal for one that is new.
    children : list of Element
    changes : dict of str to (str or None)
        New texts of attributes; None: the attribute is left out.
    replacement : str, optional
        What stands in place of the element.
    """

    tag: str
    attributes: dict[str, str] = field(default_factory=dict)
    begin: int = 0
    inside: int = 0
    end: int = 0
    children: list[Element] = field(default_factory=list)
    changes: dict[str, str | None] = field(default_factory=dict)
    replacement: str | None = None

    def child(self, tag: str) -> Element:
        """The first child of a tag, which is new where there is none."""
        found = next((x for x in self.children if x.tag == tag), None)
        if found is None:
            found = Element(tag)
            self.children.insert(0, found)
        return found


class Document:
    """Text of a description, in which elements are rewritten.

    Parameters
    ----------
    source : bytes
    label : str
        Of the description in messages.
    """

    def __init__(self, source: bytes, label: str) -> None:
        self.source, self.label = source, label
        self.root = _elements(source)
        self.is_urdf = self.root.tag == "robot"

    def text(self) -> str:
        """The text with all changes."""
        parts, at = list[bytes](), 0
        for begin, end, new in sorted(self._edits(self.root)):
            parts += [self.source[at:begin], new.encode()]
            at = end
        return b"".join([*parts, self.source[at:]]).decode()

    def element(self, kind: str, k: int, name: str, count: int) -> Element:
        """An element of a kind.

        Parameters
        ----------
        kind : str
            Of MuJoCo's compiled model; bodies and joints of a URDF too.
        k, count : int
            Index among those of its kind, and number of them.
        name : str
            Empty where it has none.

        Raises
        ------
        ModelError
            It is in another file, or has no name and cannot be counted.
        """
        every = list(self._of_kind(kind))
        if not name:
            offset = 1 if kind == "body" else 0
            if len(every) + offset == count:
                return every[k - offset]
            raise ModelError(f"{self.label}: {kind} {k} has no name, by which it is found in the text; give it one")
        for element in every:
            if element.attributes.get("name") == name:
                return element
        raise ModelError(
            f'{self.label}: {kind} "{name}" is not in this file by name; write the files that it includes into one'
        )

    def tagged(self, tag: str) -> list[Element]:
        """All elements of a tag."""
        return [x for x in _below(self.root) if x.tag == tag]

    def _of_kind(self, kind: str) -> Iterator[Element]:
        """Elements of a kind, in MuJoCo's order."""
        if self.is_urdf:
            yield from (x for x in self.root.children if x.tag == {"body": "link"}.get(kind, kind))
            return
        section = _SECTIONS.get(kind, "worldbody")
        for parent in (x for x in self.root.children if x.tag == section):
            if section != "worldbody":
                yield from (x for x in parent.children if kind != "pair" or x.tag == kind)
                continue
            bodies = [x for x in _below(parent) if x.tag == "body"]
            if kind == "body":
                yield from bodies
            else:
                yield from (x for body in (parent, *bodies) for x in _of_body(body) if x.tag in (kind, f"free{kind}"))

    def _edits(self, element: Element) -> Iterator[tuple[int, int, str]]:
        """Changes of an element and of those in it: beginning and end of what is replaced, and what stands there."""
        if element.replacement is not None:
            yield element.begin, element.end, element.replacement
            return
        new = "".join(_new_text(x) for x in element.children if not x.end)
        if element.changes or new:
            start = _with_attributes(self.source[element.begin : element.inside].decode(), element.changes)
            if new and start.endswith("/>"):
                new = f"{new}</{element.tag}>"
                start = f"{start[:-2].rstrip()}>"
            yield element.begin, element.inside, start + new
        for child in element.children:
            if child.end:
                yield from self._edits(child)


def _new_text(element: Element) -> str:
    texts = {key: text for key, text in element.changes.items() if text is not None}
    return f"<{element.tag} {attributes(texts)}/>" if element.replacement is None else element.replacement


def _with_attributes(start: str, texts: Mapping[str, str | None]) -> str:
    """A start tag with some attributes replaced, added, or left out."""
    for key, text in texts.items():
        if text is None:
            start = re.sub(rf"\s+{key}\s*=\s*(\"[^\"]*\"|'[^']*')", "", start, count=1)
            continue
        start, count = re.subn(rf"(\s{key}\s*=\s*)(\"[^\"]*\"|'[^']*')", rf'\g<1>"{text}"', start, count=1)
        if not count:
            start = re.sub(r"\s*(/?>)$", rf' {key}="{text}"\g<1>', start)
    return start


def _elements(source: bytes) -> Element:
    """The root element, with all below it."""
    parser, open_elements, roots = expat.ParserCreate(), list[Element](), list[Element]()

    def start(tag: str, attributes: dict[str, str]) -> None:
        begin = parser.CurrentByteIndex
        inside = _end_of_tag(source, begin)
        element = Element(tag, attributes, begin, inside, inside)
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


def _of_body(body: Element) -> Iterator[Element]:
    """Elements of a body, in order, without bodies and what is in them."""
    for child in body.children:
        if child.tag != "body":
            yield child
            yield from _of_body(child)


def attributes(texts: Mapping[str, str]) -> str:
    """Attributes of an element."""
    return " ".join(f"{key}={quoteattr(text)}" for key, text in texts.items())


def numbers(values: ArrayLike) -> str:
    """Numbers with all of their digits."""
    return " ".join(repr(float(x)) for x in np.ravel(values))
