"""Options of ``diransac identify --each``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from diransac.cli import screen
from diransac.cli.options import Preparation
from diransac.cli.outputs import PAGE, STDOUT, check_ending, checked, staged
from diransac.cli.workers import Cluster, Jobs, running
from diransac.identification.method import Method
from diransac.model import Model

__all__ = ["FleetOptions"]


def _option(*names: str, **about: Any) -> Any:
    """An option on a fleet of logs."""
    return typer.Option(*names, rich_help_panel="A fleet of logs", **about)


@dataclass(frozen=True)
class FleetOptions:
    """Options of a fleet of logs, one result each."""

    each: Annotated[bool, _option("--each", help="Identify from each log by itself, into a store.")] = False
    store: Annotated[
        Path | None, _option("--store", metavar="FILE.db", help="Rows, one per log; those it has are not run again.")
    ] = None
    vehicle: Annotated[
        str | None,
        _option("--vehicle", metavar="REGEX", help="Vehicle in a log's name: '(?P<vehicle>[^/]+)/(?P<time>.*)'."),
    ] = None
    jobs: Jobs = None
    cluster: Cluster = None

    def asked(self) -> bool:
        """True for a fleet.  Raises typer.BadParameter: options without ``--each``, or no store."""
        if self.each and self.store is None:
            raise typer.BadParameter("--each needs a store for its rows, --store FILE.db")
        given = [name for name in ("store", "vehicle", "jobs", "cluster") if getattr(self, name) is not None]
        if given and not self.each:
            raise typer.BadParameter(f"--{given[0]} belongs to --each, which is not given")
        return self.each

    def run(
        self,
        files: Sequence[Path],
        model: Model,
        method: Method,
        preparation: Preparation,
        like: Sequence[Mapping[str, Any]],
        report: Path | None,
        arguments: Mapping[str, Any],
        time_limit: float | None,
        as_json: bool,
    ) -> None:
        """Identify from each log, show what the fleet is like, and write the page if there is one."""
        from diransac.study.fleet import identify_each
        from diransac.study.fleet_findings import summarise_fleet

        assert self.store is not None
        if STDOUT in files:
            raise typer.BadParameter("--each reads files, not standard input; give their names")
        checked([report], [*files, self.store])
        check_ending(report, PAGE)
        prepared = {name: value for name, value in asdict(preparation).items() if value is not None}
        with running(f"{len(files)} logs", self.store, self.jobs, self.cluster) as how:
            identify_each(
                model,
                files,
                method,
                store=self.store,
                vehicle=self.vehicle,
                read=partial(preparation.read, like=like),
                configuration={"preparation": prepared, **({"like": list(like)} if like else {})},
                time_limit=time_limit,
                **how,
                **arguments,
            )
        summary = summarise_fleet(self.store)
        with staged([report], [*files, self.store]) as (page,):
            if report:
                from diransac.report.stores import write_fleet_report

                write_fleet_report(summary, page)
        screen.show(summary, as_json)
