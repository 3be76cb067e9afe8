"""Tab of files: the plan and the page to download, and plans and structures to open.

The server reads only what is uploaded: a file that names others, such as a plan its structure by a path, could make it
read any file of its machine.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from falsework.assembly.library import is_built_in
from falsework.assembly.load import load_structure
from falsework.errors import InputError
from falsework.robots.plans.robot_plan_file import load_robot_plan
from falsework.search.plans.plan_file import load_plan, save_plan
from falsework.utils.json_file import read_format
from falsework.viewer.page.recording import record
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.viewable import Viewable, viewable_of

if TYPE_CHECKING:
    from falsework.search.plans.plan import Plan
    from falsework.viewer.page.host import Host

LARGEST = 64 * 2**20
"""Size of a file that is opened, bytes."""
_MESHES = (".glb", ".obj", ".ply", ".stl", ".off", ".3dm", ".step", ".stp")
_KINDS = ",".join((".json", *_MESHES))


class FilesTab:
    """Files from and to the page."""

    def __init__(self, gui: Any, page: Host) -> None:
        """Fill the tab."""
        self._page = page
        self._plan = gui.add_button("Download the plan", hint="A plan file, as falsework plan writes it.")
        self._plan.on_click(lambda event: page.guard(event, lambda: self._send_plan(event)))
        self._html = gui.add_button("Download as a page", hint="One HTML file that plays without a server.")
        self._html.on_click(lambda event: page.guard(event, lambda: self._send_page(event)))
        self._upload = gui.add_upload_button("Open a plan or structure", mime_type=_KINDS)
        self._upload.on_upload(lambda event: page.guard(event, self._opened))

    def update(self) -> None:
        """Offer the plan where there is one."""
        self._plan.visible = self._page.model.plan is not None

    def _send_plan(self, event: Any) -> None:
        plan = self._page.model.plan
        if plan is not None and event.client is not None:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "plan.json"
                save_plan(plan, path)
                event.client.send_file_download(
                    f"{self._page.file_name}.json", path.read_bytes(), save_immediately=True
                )

    def _send_page(self, event: Any) -> None:
        if event.client is not None:
            content = record(self._page.model).encode()
            event.client.send_file_download(f"{self._page.file_name}.html", content, save_immediately=True)

    def _opened(self) -> None:
        file = self._upload.value
        self._page.show(opened(file.name, file.content, self._page.model))


def opened(name: str, content: bytes, model: ViewerState) -> ViewerState:
    """Return the viewer of an uploaded plan, robot plan or structure.

    Args:
        model: what is shown at present; its structure and cell are those of a plan that was made for them.
    """
    name = Path(name.replace("\\", "/")).name
    if len(content) > LARGEST:
        raise InputError(f"{name} has {len(content) / 2**20:.0f} MB; the page opens up to {LARGEST // 2**20} MB")
    suffix = Path(name).suffix.lower()
    if suffix not in (".json", *_MESHES):
        raise InputError(f"{name}: the page opens plans (.json) and structures in one file ({', '.join(_MESHES)})")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{Path(name).stem or 'file'}{suffix}"
        path.write_bytes(content)
        shown = _viewable(path, name, model)
    return ViewerState(
        shown.timeline, plan=shown.plan, arms=shown.arms, deadline=model.deadline, criterion=model.criterion
    )


def _viewable(path: Path, name: str, model: ViewerState) -> Viewable:
    form = read_format(path) if path.suffix == ".json" else ""
    if form.startswith("falsework.plan/"):
        plan = load_plan(path)
        return viewable_of(plan, _structure(plan, name, model))
    if form.startswith("falsework.robot-plan/"):
        robot_plan = load_robot_plan(path)
        if model.arms is None:
            raise InputError(f"{name} is a robot plan; the page opens it where it shows one of the same cell")
        structure = _structure(robot_plan.plan, name, model)
        return viewable_of(robot_plan, structure, cell=model.arms.cell)
    if form.startswith("falsework."):
        raise InputError(f"{name} has the format {form}, which names other files; the page opens single files")
    return viewable_of(load_structure(path))


def _structure(plan: Plan, name: str, model: ViewerState) -> Any:
    """Return the structure that is shown, if it is that of a plan, or a built-in one that the plan names."""
    if plan.identity == model.assembly.identity:
        return model.assembly
    source = plan.source or {"built_in": plan.name}
    if "path" in source or not is_built_in(source.get("built_in", plan.name)):
        raise InputError(f"{name} is a plan of another structure, {plan.name}; open that structure first")
    return None
