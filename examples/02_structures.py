"""Built-in structures: what there is, how to change one, and how thin an arch can be.

Run: python examples/02_structures.py
"""

from __future__ import annotations

from falsework import StabilityOracle, load_structure
from falsework.assembly import complete_state, library


def verdict(spec: str) -> str:
    """Whether a structure stands when it is complete and no robot holds a part."""
    assembly = load_structure(spec)
    return (
        "stands" if StabilityOracle(assembly).verdicts(complete_state(assembly.boundary)[None]).stable[0] else "falls"
    )


def main() -> None:
    """Print the catalogue, then look for the thinnest arch and the thinnest vault."""
    for entry in library.structures():
        assembly = entry()
        print(
            f"{entry.name:10} {assembly.part_count:3} parts, {len(assembly.contacts):3} contacts: {entry.description}"
        )
        print(f"{'':10} " + ", ".join(f"{name}={value}" for name, value in entry.parameters.items()))

    print("\nParameters carry their ranges and units:")
    for parameter in library.arch.details:
        print(f"  {parameter.name}: {parameter.range_text}")

    print("\nA semicircular arch needs 0.1075 of its radius (Milankovitch 1907):")
    for thickness in (0.12, 0.11, 0.108, 0.107, 0.1):
        print(f"  thickness {thickness}: {verdict(f'arch:blocks=80,thickness={thickness}')}")

    print("\nThe vault follows the flow of its own weight and needs next to nothing, at any size:")
    for parts in (30, 125, 500):
        print(f"  {parts} parts, 4 cm over 4 m: {verdict(f'vault:parts={parts},thickness=0.04')}")


if __name__ == "__main__":
    main()
