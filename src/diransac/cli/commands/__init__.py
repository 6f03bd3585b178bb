"""The command line; commands on one subject are a module of this package. Exit codes and messages of all.

| file | commands |
|---|---|
| `identification.py` | ``identify``, ``compare``, ``cross-validate`` |
| `inspection.py` | ``inspect``, ``map``, ``models``, ``cache`` |
| `results.py` | ``validate``, ``predict``, ``view``, ``export`` |
| `design.py`, `flight.py` | ``design``; ``simulate``, ``fly`` |
| `stores.py`, `tracking.py`, `studio.py` | ``study``, ``fleet``; ``track``; ``studio`` |
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, NoReturn, get_args, get_type_hints

import typer
from typer.core import TyperGroup

from diransac.cli import INTERRUPTED, screen
from diransac.errors import DiransacError

__all__ = ["app", "grouped"]

UsageError: type[Any] = typer.BadParameter.__mro__[1]


_MODULES = {
    "identify": "identification",
    "compare": "identification",
    "validate": "results",
    "predict": "results",
    "view": "results",
    "cross-validate": "identification",
    "track": "tracking",
    "inspect": "inspection",
    "map": "inspection",
    "simulate": "flight",
    "fly": "flight",
    "design": "design",
    "export": "results",
    "models": "inspection",
    "studio": "studio",
    "cache": "inspection",
    "fleet": "stores",
    "study": "stores",
}
"""Commands, in the order of ``--help``, and their modules in `diransac.cli.commands`."""

_CONFIG = "--config"

_VERBOSITY = {"-q": -1, "--quiet": -1, "-v": 1, "--verbose": 1}


class _Commands(Mapping[str, Any]):
    """Commands by name; the module of each is imported on first use."""

    def __init__(self) -> None:
        self._made = dict[str, Any]()

    def __getitem__(self, name: str) -> Any:
        if name not in self._made:
            module = importlib.import_module(f"diransac.cli.commands.{_MODULES[name]}")
            made = typer.main.get_command(module.app)
            self._made[name] = getattr(made, "commands", {}).get(name, made)
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(_MODULES)

    def __len__(self) -> int:
        return len(_MODULES)


class Group(TyperGroup):
    """Commands with exit code 0, 1 (failure), 2 (wrong usage), 3 (``--strict``) or 130 (Ctrl-C).

    The message of a failure is one line, and a second one for wrong usage.
    """

    def __init__(self, **about: Any) -> None:
        super().__init__(**about | {"commands": _Commands()})

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """A command by name."""
        command = super().get_command(ctx, cmd_name)
        if command is not None:
            _convert_plainly(command, ctx)
        return command

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Arguments that are left for the command."""
        _convert_plainly(self, ctx)
        return super().parse_args(ctx, args)

    def main(self, args: Sequence[str] | None = None, *positional: Any, **extra: Any) -> NoReturn:
        """Run the command line; ``--debug``, ``--progress-json``, ``-q`` and ``-v`` may stand anywhere."""
        given = list(sys.argv[1:] if args is None else args)
        words = [word for word in given if word not in ("--debug", "--progress-json", *_VERBOSITY)]
        extra["standalone_mode"] = False
        levels = [_VERBOSITY[word] for word in given if word in _VERBOSITY]
        screen.begin(given, levels[-1] if levels else 0, for_programs="--progress-json" in given)
        debugging = "--debug" in given
        try:
            code = super().main(_configured(words), *positional, **extra)
        except UsageError as error:
            where = error.ctx.command_path if error.ctx else "diransac"
            code = _say(error.format_message(), 2, f"See '{where} --help'.")
        except (DiransacError, OSError) as error:
            if debugging:
                raise
            code = _say(_message(error), 1)
        except (KeyboardInterrupt, typer.Abort):
            code = INTERRUPTED
        if code == INTERRUPTED:
            screen.note("interrupted")
        sys.exit(code or 0)


def _configured(words: list[str]) -> list[str]:
    """Words of ``identify`` with the options of its project file in place of ``--config FILE``, before those given."""
    places = [k for k, word in enumerate(words) if word.partition("=")[0] == _CONFIG]
    if not places or words[0] != "identify":
        return words
    if len(places) > 1:
        raise typer.BadParameter(f"{_CONFIG} is given twice; one project has all logs and options")
    (at,) = places
    _, equals, joined = words[at].partition("=")
    rest = words[at + 1 :] if equals else words[at + 2 :]
    name = joined if equals else next(iter(words[at + 1 :]), "")
    if not name:
        raise typer.BadParameter(f"{_CONFIG} needs the name of a project file")
    from diransac.studio.project import Project

    file = Path(name)
    return [words[0], *Project.load(file).words(file.parent), *words[1:at], *rest]


def _convert_plainly(command: Any, ctx: Any) -> None:
    """Convert the arguments of a command by `_Conversion`."""
    for parameter in command.get_params(ctx):
        if hasattr(parameter, "get_runtime_param"):  # of a release of Typer that converts by pydantic
            parameter.get_runtime_param = functools.partial(_Conversion, parameter.get_runtime_param)


@dataclasses.dataclass(frozen=True)
class _Conversion:
    """Conversion of an argument; by Typer, and pydantic, only where it is not plain or is wrong.

    Pydantic takes longer to import than NumPy.

    Parameters
    ----------
    make : callable
        Returns Typer's conversion.
    """

    make: Callable[[], Any]

    def coerce(self, value: Any, param: Any, ctx: Any) -> Any:
        """The value of an argument, as Typer's own conversion returns it."""
        several = param.multiple or param.nargs == -1
        if value is None or (several and not value):
            return () if several else None
        kind, about = param.type_descriptor.annotation, param.type_descriptor.parameter_info
        kind = next(iter(get_args(kind)), None) if several else kind
        # Kinds of arguments that are converted by a call, and what makes Typer check or convert an argument
        # otherwise.
        convert = getattr(about, "parser", None) or (kind if kind in (str, Path, int, float) else None)
        if convert and not any(getattr(about, name, None) is not None for name in ("click_type", "min", "max")):
            with suppress(ValueError):
                return [convert(x) for x in value] if several else convert(value)
        return self.make().coerce(value, param=param, ctx=ctx)


def _message(error: DiransacError | OSError) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error)


def _say(message: str, code: int, *more: str) -> int:
    """Print a message on one line of stderr, and further lines; the exit code."""
    screen.note(f"error: {message}" if message.strip() else "error", *more)
    return code


app = typer.Typer(
    cls=Group,
    name="diransac",
    help="Turn a messy log of a moving machine into a dynamical model, and say how far it can be trusted.",
    invoke_without_command=True,
    pretty_exceptions_enable=False,
)


@app.callback()
def _diransac(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    _debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error, after any command.")] = False,
    _quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no text; anywhere.")] = False,
    _verbose: Annotated[bool, typer.Option("--verbose", "-v", help="A line for every stage; anywhere.")] = False,
    _programs: Annotated[
        bool, typer.Option("--progress-json", help="Progress as JSON lines, ended by a line stop; anywhere.")
    ] = False,
) -> None:
    if version:
        from importlib.metadata import version as version_of

        screen.copy(f"diransac {version_of('diransac')}\n".encode())
        raise typer.Exit
    if context.invoked_subcommand is None:
        context.fail(f"Give a command: {', '.join(sorted(context.command.list_commands(context)))}.")  # type: ignore[attr-defined]


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """A command in which each field of a dataclass parameter is an option."""
    signature = inspect.signature(command, eval_str=True)
    groups: dict[str, Any] = {
        n: p.annotation for n, p in signature.parameters.items() if dataclasses.is_dataclass(p.annotation)
    }
    plain = [p.replace(kind=p.KEYWORD_ONLY) for n, p in signature.parameters.items() if n not in groups]
    options = [option for group in groups.values() for option in _options(group)]

    @functools.wraps(command)
    def run(**values: Any) -> None:
        for name, group in groups.items():
            values[name] = group(**{field.name: values.pop(field.name) for field in dataclasses.fields(group)})
        command(**values)

    run.__signature__ = signature.replace(parameters=[*plain, *options])  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in (*plain, *options)}
    del run.__wrapped__
    return run


def _options(group: Any) -> list[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    keyword = inspect.Parameter.KEYWORD_ONLY
    return [
        inspect.Parameter(field.name, keyword, default=field.default, annotation=hints[field.name])
        for field in dataclasses.fields(group)
    ]
