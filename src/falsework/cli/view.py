"""`falsework view`: interactive view of a plan in the browser."""

from __future__ import annotations

import os
import signal
import webbrowser
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import arg

from falsework.cli.command import UNSET, JudgingCommand, ViewableOptions
from falsework.cli.exit_code import Exit

if TYPE_CHECKING:
    from falsework.cli.output import Output
    from falsework.viewer.cells.cell_page import CellPage
    from falsework.viewer.page.page import Page


@dataclass(frozen=True, kw_only=True)
class View(JudgingCommand):
    """Show a plan, run, robot plan, state graph, structure or cell in the browser.

    The page plays the steps, shows data of clicked parts and contact forces, and replans after marked disruptions. That
    of a cell moves the arms by sliders, colours bodies that are too near, shows what is wrong with the cell, and reads
    its file again when that changes. It is served to this machine only, unless --host is given, until Ctrl-C.
    """

    rare: ClassVar[tuple[str, ...]] = ("host", "allow_host", "deadline")

    examples: ClassVar[tuple[str, ...]] = (
        "falsework view plan.json",
        "falsework view vault --robots 3 --browser",
        "falsework view cell.toml --structure my-folder",
    )

    outcomes: ClassVar[tuple[str, str]] = ("serving", "failed")

    subject: ViewableOptions
    policy: Annotated[str | None, arg(metavar="RUN", help_behavior_hint=UNSET)] = None
    """Run whose policy colours the parts and proposes new plans."""
    host: Annotated[str | None, arg(metavar="HOST", help_behavior_hint=UNSET)] = None
    """Address to serve at; local only if not given. Any other client can then view and control the page without a
    password."""
    allow_host: Annotated[str | None, arg(metavar="NAMES", help_behavior_hint=UNSET)] = None
    """Further names under which browsers may open the page, such as plans.example or a proxy's, separated by commas.
    Requests for other names, and those that pages of other sites send, are refused."""
    port: int = 8080
    """Port to serve at; the next free one is taken if it is not free."""
    robots: int = 2
    """Number of robots, if the file does not contain it."""
    deadline: float = 60.0
    """Time limit of replanning."""
    browser: bool = False
    """Open the page in the browser."""

    def run(self, output: Output) -> Exit:
        """Open, serve until interrupted."""
        from falsework.viewer.cells.cell_model import is_cell
        from falsework.viewer.cells.cell_page import view_cell
        from falsework.viewer.show import check_view, view
        from falsework.viewer.web.served_page import check_host, serve

        host = "127.0.0.1" if self.host is None else self.host
        warning = check_host(host)
        check_view(self.robots, host, self.port, self.deadline)
        place: dict[str, Any] = {"host": host, "port": self.port}
        place["allowed_hosts"] = (self.allow_host or "").split(",")
        page: Page | CellPage
        if is_cell(self.subject.spec):
            page = view_cell(self.subject.spec, self.subject.structure, **place, **self.subject.given())
            kind, name, record = "cell", self.subject.spec, {"faults": list(page.sight.faults)}
            for fault in page.sight.faults:
                output.note(f"falsework: {fault}")
            if self.browser:
                webbrowser.open(page.address)
        else:
            subject = self.subject.open(self.robots).with_policy(self.policy)
            options: dict[str, Any] = {"criterion": self.criterion, "deadline": self.deadline, "browser": self.browser}
            page = view(subject, **options, **place, wait=False)
            kind, name, record = subject.kind, subject.assembly.name, {"parts": subject.assembly.part_count}
        if warning is not None:
            output.note(f"falsework: warning: {warning}")
        output.record({"url": page.address, "kind": kind, **record})
        output.answer(Exit.DONE)
        # A shell makes commands ignore Ctrl-C that it starts in the background of a script.
        ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        end = f"kill {os.getpid()}" if ignored else "Ctrl-C"
        output.say(f"{kind} {'' if kind == 'cell' else 'of '}{name} at {page.address}; {end} ends it")
        serve(page)
        return Exit.DONE
