"""Hand a plan on: an animation for any viewer, a stage for a robot simulator, a table for a crew, blocks for COMPAS.

Run: python examples/10_hand_on.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import falsework as fw


def main() -> None:
    """An arch, built by two robots or by a crew with two props."""
    arch = fw.load_structure("arch:blocks=7")
    plan = fw.find_plans(arch).unwrap()

    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        fw.export(plan, folder / "arch.glb", arch)
        fw.export(plan, folder / "arch.usda", arch)
        fw.export(plan, folder / "arch.csv", arch)  # the sheet as a table; `.pdf` has pictures
        fw.export(arch, folder / "arch.json", format="compas-dem")
        assert fw.load_structure(folder / "arch.json").identity == arch.identity  # nothing is lost on the way
        for file in sorted(folder.iterdir()):
            print(f"{file.name}: {file.stat().st_size} bytes")

    sheet = fw.sheet(arch, plan)
    for step in sheet.steps:
        where = f" {sheet.comes_in(step)}" if step.place else ""
        hold = ", ".join(sheet.name(part) for part, _ in step.hold) or "nothing"
        print(f"{step.number}. {step.verb} {sheet.named(step)}{where}; then hold {hold}")


if __name__ == "__main__":
    main()
