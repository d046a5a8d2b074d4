"""Learns a drive of four harmonics under which the force is as even over a period as four harmonics can make it.

A sine's force comes and goes twice a period. The amplitudes and phases of the harmonics 1, 3, 5 and 7 are the
parameters of a module of torch; its forward gives the force at 100 times of the periodic state, and Adam's steps follow
the exact derivatives of every run by them: python circuits/learned_drive.py
"""

from __future__ import annotations

import numpy as np
import torch

import fingerspice as fs

# Table 1's layers and contact, the skin right at all harmonics; one source for each of them.
DECK = """Fingerpad on a touchscreen under four harmonics of 100 Hz
.include fingerspice.lib
V1      h1    0          SIN(0 150 100)
V3      h3    h1         SIN(0 20 300)
V5      h5    h3         SIN(0 10 500)
V7      drive h5         SIN(0 5 700)
Xcoat   drive top  area  LAYER d=1u eps_r=3.9 r=0.2meg
Xgap    top   skin area  GAP   d=3.5u eps_r=1 r=1meg fn=0.5 mu=0.3 alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000
Xskin   skin  0    area  SKIN_DISPERSIVE d=350u
.tran 10u 10m uic
.end
"""
PERIOD, TIMES = 0.01, 100
# The force that is wanted (N), and the largest first step in V and degrees.
WANTED, STEP = 0.1, 8.0


def simulator() -> torch.nn.Module:
    """The module: force (N) at `TIMES` times of a period by amplitudes (V) and phases (degrees) of the harmonics."""
    start = {"V1.amplitude": 150.0, "V3.amplitude": 20.0, "V5.amplitude": 10.0, "V7.amplitude": 5.0}
    # Steps of a derivative are relative, so that no phase may be 0; the first one would only shift the period.
    start |= {"V3.phase_deg": 1.0, "V5.phase_deg": 1.0, "V7.phase_deg": 1.0}
    t = PERIOD * np.arange(TIMES) / TIMES
    return fs.torch.Simulator(fs.parse_netlist(DECK), start, "f_el", t=t, t_stop=PERIOD, periodic=True, rtol=1e-4)


def learn(module: torch.nn.Module, steps: int) -> list[float]:
    """Let the module learn; the root mean square deviation from the wanted force before every step, relative."""
    optimizer = torch.optim.Adam(module.parameters(), lr=STEP)
    pace = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    deviations = []
    for _ in range(steps):
        optimizer.zero_grad()
        loss = (module() / WANTED - 1.0).square().mean()
        loss.backward()
        optimizer.step()
        pace.step()
        deviations.append(loss.item() ** 0.5)
    return deviations


def main() -> None:
    module = simulator()
    deviations = learn(module, 40)
    print(f"deviation from {WANTED:g} N: {deviations[0]:.3f} of it at first, {deviations[-1]:.3f} at last")
    for name, value in module.named_parameters():
        print(f"{name:14} {value.item():8.2f}")


if __name__ == "__main__":
    main()
