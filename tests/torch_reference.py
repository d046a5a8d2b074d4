"""The model of one finger in plain functions of torch, integrated by torchdiffeq: slow, and nothing of the package.

Coating, gap and skin are in series; the equations are those of the paper (numbers in brackets), in SI but for the
contact's constants, which are in mm and N as in the netlist. The values are tensors by the path that the netlist gives
them. Derivatives come from autograd through the solver's steps, or from its adjoint equation.
"""

import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor
from torchdiffeq import odeint, odeint_adjoint

EPS0 = 8.854e-12
Values = Mapping[str, Tensor]
Drive = Callable[[Tensor, Values], Tensor]


def skin(f: Tensor) -> tuple[Tensor, Tensor]:
    """Resistivity (ohm m) and relative permittivity of the stratum corneum (18, 19)."""
    z = torch.log10(f)
    rho = 10.0 ** (-0.023 * z**3 + 0.0795 * z**2 - 0.2133 * z + 4.9229)
    eps = 10.0 ** (-0.00286 * z**5 + 0.03564 * z**4 - 0.15785 * z**3 + 0.33963 * z**2 - 0.6235 * z + 4.1598)
    return rho, eps


def area_and_force(u: Tensor, p: Values) -> tuple[Tensor, Tensor]:
    """Ridge contact area (m^2) and electroadhesive force (N) at a gap voltage (V) (1 to 7)."""
    d, load, alpha, m = p["Xgap.d"], p["Xgap.fn"], p["Xgap.alpha"], p["Xgap.m_exp"]
    beta, n, mu = p["Xgap.beta"], p["Xgap.n_exp"], p["Xgap.mu"]
    stress = EPS0 * p["Xgap.eps_r"] * u**2 / (2.0 * d**2)
    # The work of adhesion is stress times d (N/m, a thousandth of it in N/mm); a root of u^2 has no slope at 0 V.
    work = torch.sqrt(EPS0 * p["Xgap.eps_r"] * n**2 / (1000.0 * d * (n - m)) * beta ** (1.0 / n))
    # The root of (4) in the logarithm of A_R0 (mm^2).
    pull = u.abs() * work * alpha ** (-0.5 / m)
    power = 0.5 * (1.0 + 1.0 / m - 1.0 / n)
    y = _root(*(float(one.detach()) for one in (alpha, m, load, pull, power)))
    # One step of Newton's method from the root has the derivatives of the root by everything.
    left, adhesion = torch.exp(y / m) * alpha ** (-1.0 / m), pull * torch.exp(power * y)
    slope = (left / m - power * adhesion).detach()
    a0 = 1e-6 * torch.exp(y - (left - adhesion - load) / slope)
    b = 1e-12 * p["Xgap.c2"] * mu**2 / a0
    linear, rest = 1.0 + 2.0 * b * stress * load, a0 - b * load**2
    area = 2.0 * rest / (linear + torch.sqrt(linear**2 + 4.0 * b * stress**2 * rest))
    return area, stress * area


def _root(alpha: float, m: float, load: float, pull: float, power: float) -> float:
    y = math.log(alpha * load**m)
    for _ in range(60):
        left, adhesion = math.exp(y / m) * alpha ** (-1.0 / m), pull * math.exp(power * y)
        # In logarithms the iteration is monotone from the left.
        step = math.log(left / (load + adhesion)) / (1.0 / m - power * adhesion / (load + adhesion))
        y -= step
        if abs(step) < 1e-15 * abs(y):
            break
    return y


def sine(t: Tensor, p: Values) -> Tensor:
    """SIN(0 amplitude frequency)."""
    return p["Vdrive.amplitude"] * torch.sin(2.0 * math.pi * p["Vdrive.frequency"] * t)


def square(t: Tensor, p: Values) -> Tensor:
    """SQUARE(amplitude frequency); torchdiffeq asks for either side of an edge by a time just beside it."""
    half = int(
        torch.searchsorted(edges(float(t.detach()) + 1.0 / float(p["Vdrive.frequency"].detach()), p), t, right=True)
    )
    return p["Vdrive.amplitude"] * (1.0 - 2.0 * (half % 2))


def edges(t_stop: float, p: Values) -> Tensor:
    """Times of a square's jumps after the start, s."""
    half = 0.5 / float(p["Vdrive.frequency"].detach())
    return half * torch.arange(1, max(2, math.ceil(t_stop / half)), dtype=torch.float64)


class Finger:
    """A finger's run from rest: gap voltages (V) at times (s), and the mean force (N) to the last of them.

    State: the electric displacements of all layers that have leaked through them (C/m^2), under `mobile` their charges
    over the area at rest; and the integral of the force.
    """

    def __init__(self, p: Values, drive: Drive, law: str = "local") -> None:
        self.p, self.drive, self.law = p, drive, law
        rho, eps = skin(p["Xskin.f"])
        self.c = torch.stack([
            EPS0 * p["Xcoat.eps_r"] / p["Xcoat.d"],
            EPS0 * p["Xgap.eps_r"] / p["Xgap.d"],
            EPS0 * eps / p["Xskin.d"],
        ])  # fmt: skip
        zero = torch.zeros((), dtype=torch.float64)
        self.leak = torch.stack([1.0 / p["Xcoat.r"], 1.0 / p["Xgap.r"], zero])
        self.leak_per_area = torch.stack([zero, zero, 1.0 / (rho * p["Xskin.d"])])
        self.k = 1.0 / (self.c * (1.0 / self.c).sum())
        self.area0 = area_and_force(zero, p)[0].detach()

    def voltages(self, t: Tensor, leaked: Tensor) -> Tensor:
        """Voltages of the layers, V: those of the leaked charges, and each layer's part of the source's."""
        inside = leaked / self.c
        at_once, inside = self.k * self.drive(t, self.p), self.k * inside.sum() - inside
        if self.law == "local":
            return at_once + inside
        # u = at_once + inside A_0 / A(u): Newton's method, whose last step has the derivatives.
        u = (at_once + inside)[1].detach()
        for _ in range(30):
            one = u.clone().requires_grad_()
            with torch.enable_grad():
                miss = one - self._gap(at_once[1].detach(), inside[1].detach(), one)
                slope = torch.autograd.grad(miss, one)[0]
            u = u - miss.detach() / slope
            if abs(float(miss.detach())) < 1e-13 * (1.0 + abs(float(u))):
                break
        gap = u - (u - self._gap(at_once[1], inside[1], u)) / slope
        return at_once + inside * self.area0 / area_and_force(gap, self.p)[0]

    def _gap(self, at_once: Tensor, inside: Tensor, u: Tensor) -> Tensor:
        return at_once + inside * self.area0 / area_and_force(u, self.p)[0]

    def rate(self, t: Tensor, y: Tensor) -> Tensor:
        """Leaking currents per area, and the force."""
        u = self.voltages(t, y[:-1])
        area, force = area_and_force(u[1], self.p)
        per_area = area if self.law == "local" else self.area0
        current = (self.leak + self.leak_per_area * area) * u / per_area
        return torch.cat([current, force.unsqueeze(0)])

    def run(
        self, t: Tensor, *, adjoint: bool = False, tol: float = 1e-9, jumps: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Gap voltages at times `t` from 0 s on, and the mean force; edges of the source are `jumps`.

        The adjoint solves the state backward from one time to the next, which is unstable: the times should lie close.
        """
        how = {"method": "dopri5", "rtol": tol, "atol": tol * 1e-6}
        if jumps is not None:
            how["options"] = {"jump_t": jumps}
        y0 = torch.zeros(4, dtype=torch.float64)
        if adjoint:
            wanted = tuple(one for one in self.p.values() if one.requires_grad)
            states = odeint_adjoint(
                _Anew(self), y0, t, adjoint_params=wanted, adjoint_options=dict(how.get("options", {})),
                **how,
            )  # fmt: skip
        else:
            states = odeint(self.rate, y0, t, **how)
        u = torch.stack([self.voltages(at, y[:-1])[1] for at, y in zip(t, states, strict=True)])
        return u, states[-1, -1] / t[-1]


class _Anew(torch.nn.Module):
    """The rate with the layers' constants made of the parameters anew, as the adjoint equation differentiates it."""

    def __init__(self, finger: Finger) -> None:
        super().__init__()
        self.finger = finger

    def forward(self, t: Tensor, y: Tensor) -> Tensor:
        finger = self.finger
        return Finger(finger.p, finger.drive, finger.law).rate(t, y)
