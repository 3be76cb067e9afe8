"""Tab of what is seen: forces, motion, arms, section, parts moved apart, screenshot and legend."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from falsework.viewer.appearance import SceneView
from falsework.viewer.arrows import PRESSES, Arrows, arrows_of_step
from falsework.viewer.page.page_text import about_text, legend_text
from falsework.viewer.pictures.picture import png_of
from falsework.viewer.section import Axis

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from falsework.viewer.page.host import Host
    from falsework.viewer.proof import StateProof

FORCES = ("contact forces", "friction", "gravity")
"""Kinds of arrows for which the proof of a state is asked."""
_MOTIONS = ("motion", "sliding")
_SECTIONS: dict[str, Axis | None] = {"none": None, "across x": "x", "across y": "y", "across z": "z"}


class LookTab:
    """What is drawn of the present state. Controls without a function there are not shown."""

    def __init__(self, gui: Any, page: Host) -> None:
        """Fill the tab."""
        self._page = page
        model = page.model

        def toggle(name: str, value: bool, hint: str | None = None) -> Any:
            box = gui.add_checkbox(name, initial_value=value, hint=hint)
            box.on_update(lambda event: page.guard(event, page.refresh))
            return box

        self._forces = {kind: toggle(kind.capitalize(), value=False) for kind in FORCES}
        self.motion = toggle("Motion", value=True, hint="How parts would move, where the state is not stable.")
        self.presses = toggle("Presses", value=True)
        self._arms = toggle("Arms", value=True)
        if model.policy is not None:
            self._chances = toggle("Probabilities of the policy", value=model.show_probabilities)
        self.explode = gui.add_slider("Explode", min=0.0, max=1.0, step=0.05, initial_value=0.0)
        self.explode.on_update(lambda event: page.guard(event, self._viewed))
        self._axis = gui.add_dropdown(
            "Section", tuple(_SECTIONS), hint="Cuts the structure by a plane across an axis."
        )  # fmt: skip
        self._axis.on_update(lambda event: page.guard(event, self._viewed))
        self._keep = gui.add_slider("Section leaves", min=0.0, max=1.0, step=0.01, initial_value=0.5, visible=False)
        self._keep.on_update(lambda event: page.guard(event, self._viewed))
        self._shot = gui.add_button("Screenshot")
        self._shot.on_click(lambda event: page.guard(event, lambda: self._taken(event)))
        self._about = gui.add_html("")
        self._legend = gui.add_html("")

    @property
    def asks(self) -> bool:
        """Whether the proof of the present state is needed."""
        return self._page.model.unproven or any(box.value for box in self._forces.values())

    @property
    def arms(self) -> bool:
        """Whether the arms are shown."""
        return bool(self._arms.value)

    def update(self) -> None:
        """Show arrows, motion and texts of the present state."""
        model, scene = self._page.model, self._page.scene
        if model.policy is not None:
            model.show_probabilities = bool(self._chances.value)
        proof = model.proof() if self.asks else None
        presses = arrows_of_step(model.timeline, model.step) if model.disruption.empty else {}
        arrows = self._chosen(proof, presses)
        moved = proof.moved if proof is not None and any(kind in arrows for kind in _MOTIONS) else {}
        scene.see_through(any(some.inside for some in arrows.values()) or bool(presses and arrows))
        scene.show_arrows(arrows, moved, *([] if proof is None else [proof.motion_color]))
        scene.show_scale(arrows.values())
        falls = proof is not None and not proof.stable
        self.motion.visible = falls
        for kind in ("contact forces", "friction"):
            self._forces[kind].visible = not falls
        self.presses.visible = any(model.timeline.presses)
        self._arms.visible = model.arms is not None
        self._about.content = about_text(model)
        self._legend.content = legend_text(model, arrows)

    def _chosen(self, proof: StateProof | None, presses: dict[str, Arrows]) -> dict[str, Arrows]:
        """Return the arrows to draw; none where parts are moved apart, away from their forces."""
        if self._page.model.view.explode:
            return {}
        found = dict(presses) if self.presses.value else {}
        if proof is None:
            return found
        kinds = [kind for kind, box in self._forces.items() if box.value]
        kinds += _MOTIONS if self.motion.value else ()
        if PRESSES in found:
            kinds.append(PRESSES)
        return found | {kind: some for kind, some in proof.arrows.items() if kind in kinds}

    def _viewed(self) -> None:
        axis = _SECTIONS[self._axis.value]
        self._keep.visible = axis is not None
        self._page.model.view = SceneView(self.explode.value, axis, self._keep.value)
        self._page.refresh()

    def _taken(self, event: Any) -> None:
        client = event.client
        if client is None:
            return
        height, width = client.camera.image_height, client.camera.image_width
        pixels: NDArray[np.uint8] = client.get_render(height, width, timeout=30.0)
        client.send_file_download(f"{self._page.file_name}.png", png_of(pixels[..., :3]), save_immediately=True)
