"""`falsework view`: interactive view of a plan in the browser."""

from __future__ import annotations

import webbrowser
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import arg

from falsework.cli.command import UNSET, Command, Exit
from falsework.cli.subject import SubjectOptions
from falsework.errors import InputError

if TYPE_CHECKING:
    from falsework.cli.output import Output


@dataclass(frozen=True, kw_only=True)
class View(Command):
    """Show a plan, run, robot plan, state graph or structure on a page in the browser.

    Play the steps, click parts, look at forces, mark what has gone wrong and plan anew. The page is served to this
    machine alone unless --host says otherwise. Ends with Ctrl-C.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "falsework view plan.json",
        "falsework view vault --robots 3 --browser",
    )

    subject: SubjectOptions
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
    """Number of robots where the file does not give one."""
    deadline: float = 60.0
    """Time limit of replanning."""
    criterion: Literal["contact", "equilibrium"] = "contact"
    """Stability criterion: compliant contacts without prestress bring every part to rest, or (paper) contact forces
    in balance exist."""
    browser: bool = False
    """Open the page in the browser."""

    def run(self, output: Output) -> Exit:
        """Open, serve until interrupted."""
        from falsework.assembly.state import check_robots
        from falsework.viewer.page.page import Page, check_host, import_viser, serve
        from falsework.viewer.page.viewer_state import Model

        check_robots(self.robots)
        if not 0 <= self.port <= 65535:
            raise InputError(f"there is no port {self.port}; give 1 to 65535")
        if not self.deadline > 0:
            raise InputError(f"a deadline of {self.deadline:g} s leaves no time; give more than 0")
        host = "127.0.0.1" if self.host is None else self.host
        warning = check_host(host)
        import_viser()
        subject = self.subject.open(self.robots).with_policy(self.policy)
        model = Model(
            subject.timeline,
            plan=subject.plan,
            policy=subject.policy,
            graph=subject.graph,
            arms=subject.arms,
            criterion=self.criterion,
            deadline=self.deadline,
        )
        page = Page(model, host=host, port=self.port, allowed_hosts=(self.allow_host or "").split(","))
        if warning is not None:
            output.note(f"falsework: warning: {warning}")
        output.record({"address": page.address, "kind": subject.kind, "parts": subject.assembly.part_count})
        output.say(f"{subject.kind} of {subject.assembly.name} at {page.address}; Ctrl-C ends it")
        if self.browser:
            webbrowser.open(page.address)
        serve(page)
        return Exit.DONE
