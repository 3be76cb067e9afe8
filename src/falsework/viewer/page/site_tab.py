"""Tab of disruptions on site: marks by clicks, and new plans."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from falsework.viewer.page.disruption import ClickMode
from falsework.viewer.page.page_text import marked_text
from falsework.viewer.web.markup import markdown_text

if TYPE_CHECKING:
    from falsework.viewer.page.host import Host

NO_MORE_THAN = 400
"""Largest number of robots in the input field."""


class SiteTab:
    """Marks and replanning."""

    def __init__(self, gui: Any, page: Host) -> None:
        """Fill the tab."""
        self._page = page
        model = page.model
        self._tool = gui.add_dropdown(
            "A click will", tuple(str(tool) for tool in ClickMode), initial_value=str(model.tool)
        )  # fmt: skip
        self._tool.on_update(lambda event: page.guard(event, self._chosen))
        self._robots = gui.add_number("Robots", model.disruption.robots, min=1, max=NO_MORE_THAN, step=1)
        self._robots.on_update(lambda event: page.guard(event, self._counted))
        self._marked = gui.add_markdown("")
        self._replan = gui.add_button("Replan" if len(model.timeline) else "Find a plan", color=(0, 114, 178))
        self._replan.on_click(lambda event: page.guard(event, self._asked))
        self._clear = gui.add_button("Clear marks")
        self._clear.on_click(lambda event: page.guard(event, self._cleared))
        self._back = gui.add_button("Back to the previous plan")
        self._back.on_click(lambda event: page.guard(event, self._returned))
        self.answer = gui.add_markdown("")

    def update(self) -> None:
        """Show the marks."""
        model = self._page.model
        self._marked.content = marked_text(model)
        self._clear.visible = not model.disruption.empty
        self._back.visible = model.can_go_back

    def say(self, text: str) -> None:
        """Show the answer to a request, in Markdown."""
        self.answer.content = text

    def _chosen(self) -> None:
        self._page.model.tool = ClickMode(self._tool.value)
        self._page.refresh()

    def _counted(self) -> None:
        self._page.model.set_robots(int(self._robots.value))
        self._page.refresh()

    def _cleared(self) -> None:
        self._page.model.clear_marks()
        self.say("")
        self._page.refresh()

    def _asked(self) -> None:
        self._page.pause()
        self._replan.disabled = True
        self.say("planning ...")
        try:
            answer = self._page.model.replan()
            self._page.plan_changed(markdown_text(answer.words))
        finally:
            self._replan.disabled = False

    def _returned(self) -> None:
        self._page.model.go_back()
        self._page.plan_changed("This is the previous plan.")
