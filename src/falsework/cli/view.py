"""`falsework view`: interactive view of a plan in the browser."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import arg

from falsework.cli.command import UNSET, JudgingCommand
from falsework.cli.exit_code import Exit
from falsework.cli.subject import ViewableOptions

if TYPE_CHECKING:
    from falsework.cli.output import Output


@dataclass(frozen=True, kw_only=True)
class View(JudgingCommand):
    """Show a plan, run, robot plan, state graph or structure in the browser.

    The page plays the steps, shows data of clicked parts and contact forces, and replans after marked disruptions. It
    is served to this machine only, unless --host is given, until Ctrl-C.
    """

    rare: ClassVar[tuple[str, ...]] = ("host", "allow_host", "deadline")

    examples: ClassVar[tuple[str, ...]] = (
        "falsework view plan.json",
        "falsework view vault --robots 3 --browser",
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
        from falsework.viewer.page.page import check_host, serve
        from falsework.viewer.show import check_view, view

        host = "127.0.0.1" if self.host is None else self.host
        warning = check_host(host)
        check_view(self.robots, host, self.port, self.deadline)
        subject = self.subject.open(self.robots).with_policy(self.policy)
        page = view(
            subject,
            criterion=self.criterion,
            deadline=self.deadline,
            host=host,
            port=self.port,
            allowed_hosts=(self.allow_host or "").split(","),
            browser=self.browser,
            wait=False,
        )
        if warning is not None:
            output.note(f"falsework: warning: {warning}")
        output.record({"url": page.address, "kind": subject.kind, "parts": subject.assembly.part_count})
        output.answer(Exit.DONE)
        # A shell makes commands ignore Ctrl-C that it starts in the background of a script.
        ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        end = f"kill {os.getpid()}" if ignored else "Ctrl-C"
        output.say(f"{subject.kind} of {subject.assembly.name} at {page.address}; {end} ends it")
        serve(page)
        return Exit.DONE
