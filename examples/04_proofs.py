"""Why a structure stands or falls: forces that balance it, or a motion by which it collapses.

Run: python examples/04_proofs.py
"""

from __future__ import annotations

import numpy as np

from falsework import StabilityOracle, load_structure, verify_certificates
from falsework.assembly import complete_state


def main() -> None:
    """A semicircular arch falls when it is thinner than about a tenth of its radius."""
    for thickness in (0.20, 0.12, 0.08):
        arch = load_structure(f"arch:blocks=31,thickness={thickness}")
        state = complete_state(arch.boundary)[None]
        verdicts = StabilityOracle(arch).verdicts(state, require_certificate=True)

        # The checker starts from the assembly alone and trusts no solver.
        assert verify_certificates(arch, state, verdicts).all()

        if verdicts.stable[0]:
            assert verdicts.forces is not None
            print(f"thickness {thickness}: stands; largest normal force {verdicts.forces[0, :, 0].max():.0f} N")
        else:
            assert verdicts.velocity is not None
            speed = np.linalg.norm(verdicts.velocity[0, :, :3], axis=1)
            name = arch.names[int(speed.argmax())]
            print(
                f"thickness {thickness}: falls; {name} moves fastest, {np.sum(speed > 0.01 * speed.max())} parts move"
            )


if __name__ == "__main__":
    main()
