"""Texts that end comments and strings, control terminals, or are words of a language: what a crafted file may hold."""

import diransac as dr

CODE = "__attribute__((constructor)) static void evil(void) { abort(); }"
"""C that ends the program in which it is compiled."""

TEXTS = {
    "backslash": "m\\",
    "trigraph": "m??/",
    "end of comment": f"m */ {CODE} /*",
    "spliced end": f"m *\\\n/ {CODE} /*",
    "trigraph in end": f"m *??/\n/ {CODE} /*",
    "begin of comment": "m /* /*/ //",
    "line": f"m\n{CODE}",
    "preprocessor": f"m\n#error evil\n*/\n#error evil\n{CODE}",
    "carriage return": f"m\r*/{CODE}\r\n",
    "nul": "m\0s",
    "escape": "m\x1b[2J\x1b]0;evil\x07",
    "delete": "m\x7f",
    "c1": "m\x9b2J\x85\x90evil\x9c",
    "line separator": "m\u2028import evil\u2029",
    "bidirectional": "m\u202e\u2066evil\u2069",
    "surrogate": "m\udc9b",
    "no character": "m\uffff\U000e0001",
    "byte order mark": "\ufeffm",
    "quotes": "m\"'`",
    "docstring": 'm"""\nraise SystemExit("evil")\n"""',
    "docstring ends": 'm"""',
    "percent": "%s%n{0}{__class__}%",
    "xml": "]]><!-- -- --><evil a=\"'&amp;",
    "yaml": "m\n- evil: !!python/object/apply:os.abort []\n# : \t[{",
    "formula": '=HYPERLINK("http://evil","m")',
    "markup": "[bold red]m[/] [link=file:///evil]m[/link]",
    "mathematics": r"$\frac{$m^",
    "long": "m" * 5000,
    "empty": "",
    "greek": "µ·rad/s² °",
    "outside": "\U0001d6fc",
}

NAMES = (
    "derivative", "derivative_of", "step", "parameters", "np", "STATES", "INPUTS", "PARAMETERS", "dt", "w0",
    "double", "void", "main", "printf", "sin", "INFINITY", "NAN", "template", "operator", "requires", "print", "list",
    "match", "type", "self", "null", "true", "yes", "NO", "on", "y", "jac", "hess", "e1", "inf", "nan", "_b", "a__b",
    "µ", "\U0001d6fc", "l" * 5000,
)  # fmt: skip
"""Names that a model may have, and that the files of its exports use themselves, or languages do."""


def named(text: str = "m", names: tuple[str, ...] = ("x", "push", "mass", "drag")) -> dr.Model:
    """A driven mass with drag whose units and name are a text, and whose coordinate, input and parameters have names.

    Its acceleration is (push - drag v) / mass.
    """
    coordinate, push, mass, drag = names
    return dr.Model(
        text or "m",
        {coordinate: text},
        {push: text},
        {mass: dr.Parameter(text, positive=True), drag: dr.Parameter(text)},
        lambda q, v, a, u, p: [p[mass] * a[coordinate] + p[drag] * v[coordinate] - u[push]],
    )
