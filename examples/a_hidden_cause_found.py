"""A hidden cause found: a car with a turned steering sensor is driven and diagnosed.

python -m examples.a_hidden_cause_found
"""

from __future__ import annotations

from dynssm_ros import diagnose, recorded, simulate
from dynssm_ros.identification.result.diagnosis import Diagnosis

HIDDEN = {"steering_offset": {"offset": 0.03}}  # rad


def main() -> Diagnosis:
    """Hides an offset of the steering sensor and prints what the diagnosis says of it."""
    drive = simulate("orca", "club", duration=60.0, plant="rk4", noise=(0.01, 0.01, 0.03), effects=HIDDEN)
    found = diagnose(recorded(drive), "orca")
    for cause in found.causes:
        values = ", ".join(f"{name} {value:.3g}" for name, value in cause.values.items())
        print(f"{cause.effect}: {values} (delta BIC {cause.delta_bic:.0f}); as likely: {cause.alternatives or 'none'}")
    return found


if __name__ == "__main__":
    main()
