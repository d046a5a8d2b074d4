"""Random decks with every device, source and directive, and both charge laws, for the export to ngspice."""

import random

import fingerspice as fs
from scenes import quietly

GAP = "fn=0.5 mu=0.3 alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000"
PERIOD = 1e-3
STEPS = 1000
"""Of ngspice in a `PERIOD`."""
SOURCES = ("sin", "pulse", "jump", "exp", "pwl", "repeat", "square", "dc", "python")
NETWORKS = ("stack", "two sources", "amplifier", "ungrounded", "shunt", "current", "divider", "two fingers", "no gap")


def _source(rng: random.Random, kind: str, scale: float) -> str:
    """A source function of about `scale` (V or A) with times of about a `PERIOD`, as a deck has it."""
    a, b = (rng.choice((-1.0, 1.0)) * scale * rng.uniform(0.5, 1.0) for _ in range(2))
    t = [PERIOD * rng.uniform(0.1, 0.3) for _ in range(4)]
    return {
        "sin": f"SIN({0.3 * b!r} {a!r} {rng.uniform(0.5, 2.0) / PERIOD!r} {rng.choice((0.0, t[0]))!r} "
        f"{rng.choice((0.0, 300.0))!r} {rng.choice((0, 0, 40))})",
        "pulse": f"PULSE({b!r} {a!r} {t[0]!r} {t[1]!r} {t[2]!r} {t[3]!r} {sum(t)!r})",
        "jump": f"PULSE({0.5 * b!r} {a!r} {rng.choice((0.0, t[0]))!r} 0 0 {t[1]!r} {t[1] + t[2]!r})",
        "exp": f"EXP({0.2 * b!r} {a!r} {rng.choice((0, t[0]))!r} {t[1]!r} {t[0] + t[2]!r} {t[3]!r})",
        "pwl": f"PWL(0 0 {t[0]!r} {a!r} {t[0]!r} {0.5 * b!r} {t[0] + t[1]!r} {b!r})",
        "repeat": f"PWL(0 0 {t[0]!r} {a!r} {t[0] + t[1]!r} {b!r} {sum(t)!r} 0 r={t[0]!r})",
        "square": f"SQUARE({a!r} {rng.uniform(0.8, 3.0) / PERIOD!r} {rng.choice((0.5, 0.3))})",
        "dc": f"DC {a!r}",
        "python": f"SIN(0 {a!r} {1.0 / PERIOD!r})",
    }[kind]


def layers(rng: random.Random, slow: bool, top: str, low: str, area: str, number: str = "") -> list[str]:
    """A coating, a gap and a skin between two nodes, each of a random kind; all leak, for the operating point."""
    coat = rng.choice(
        (f"LAYER d={rng.uniform(0.5, 3.0):.3f}u eps_r=3.9 r=0.2meg", "SLAB d=2u eps_r=3 rho=1e9 e_max=inf")
    )
    skin = rng.choice((f"SKIN d=350u f={rng.choice(('100', '1k', '5k'))}", "SKIN_DISPERSIVE d=300u"))
    kind = (
        f" tau={rng.uniform(0.2, 1.0):.3f}m" if slow else rng.choice(("", "", f" a_fix={rng.uniform(20.0, 40.0):.3f}"))
    )
    film = [f"Xfilm{number} t{number} t{number}b {area} LAYER d=5u eps_r=3.5 r=30meg"] if rng.random() < 0.3 else []
    return [
        f"Xcoat{number} {top} t{number} {area} {coat}",
        *film,
        f"Xgap{number} t{number}{'b' if film else ''} s{number} {area} GAP d={rng.uniform(3.0, 6.0):.3f}u eps_r=1 "
        f"r={rng.choice(('1meg', '3meg'))} {GAP}{kind}",
        f"Xskin{number} s{number} {low} {area} {skin}",
    ]


def _network(rng: random.Random, kind: str, slow: bool, drive: str, second: str, current: str) -> list[str]:
    """Elements of a network: volts in `drive` and `second`, milliamperes in `current`."""
    # Time constants of many steps, to which ngspice's error is relative.
    r, c = f"{rng.uniform(0.2, 1.0):.3f}meg", f"{rng.uniform(80.0, 300.0):.1f}p"
    state = rng.getstate()
    finger = layers(rng, slow, "drive", "0", "area")
    rng.setstate(state)
    floating = layers(rng, slow, "drive", "body", "area")
    return {
        "stack": [f"Vdrive drive 0 {drive}", *finger],
        "two sources": [f"Vdrive drive m {drive}", f"Vlow 0 m {second}", *finger],
        "amplifier": [
            f"Vdrive amp 0 {drive}", f"Rout amp drive {r}", f"Ccable drive 0 {c}", *finger,
        ],
        "ungrounded": [
            f"Vdrive drive 0 {drive}", *floating, "Rbody body far 0.2meg", f"Cbody far 0 {c}",
        ],
        "shunt": [f"Vdrive amp 0 {drive}", f"Cs amp drive {c}", f"Rs drive 0 {r}", *finger],
        "current": [f"Idrive 0 drive {current}", f"Rp drive 0 {r}", *finger],
        "divider": [
            f"Vdrive amp 0 {drive}", f"R1 amp drive {r}", f"C1 drive 0 {c}", f"Iin 0 drive {current}",
            *finger,
        ],
        "two fingers": [
            f"Vdrive drive 0 {drive}", *layers(rng, slow, "drive", "body", "left", "1"),
            *layers(rng, slow, "drive", "body", "right", "2"), f"Rbody body far {r}", f"Cbody far 0 {c}",
        ],
        "no gap": [
            f"Vdrive drive 0 {drive}", f"R1 drive a {r}", "X1 a b area LAYER d=2u eps_r=4 r=1meg",
            "X2 b 0 area SKIN_DISPERSIVE d=350u", "Varea area 0 35",
        ],
    }[kind]  # fmt: skip


def deck(seed: int) -> tuple[str, fs.Circuit, str]:
    """Deck number `seed`: what it is, the circuit, and its charge law.

    Parts of it come in subcircuits and from parameters; a source only Python has comes by `replace`.
    """
    rng = random.Random(f"export {seed}")
    network, kind = NETWORKS[seed % len(NETWORKS)], SOURCES[seed // 2 % len(SOURCES)]
    law = ("local", "mobile")[seed % 2]
    slow = rng.random() < 0.25
    volts = rng.choice((40.0, 120.0))
    drive = _source(rng, kind, volts)
    second = _source(rng, rng.choice(("sin", "dc", "pulse")), 0.3 * volts)
    current = _source(rng, "sin" if kind == "dc" else kind, volts * 2e-6)
    lines = _network(rng, network, slow, drive, second, current)
    if rng.random() < 0.4:
        inside = [line for line in lines if line[0] == "X"]
        outside = [line for line in lines if line[0] != "X"]
        nodes = sorted({word for line in inside for word in line.split()[1:4]} - {"0"})
        call = [f".subckt part {' '.join(nodes)} u=1", *inside, ".ends", f"Xp {' '.join(nodes)} part u={{v}}"]
        lines = [".param v=2", *outside, *call]
    uic = rng.random() < 0.6
    step = PERIOD / STEPS
    extra = rng.choice(("", f" {0.5 * PERIOD!r} {step!r}")) if uic else ""
    head = [f"Random deck {seed}: {network}, {kind}", f".include fingerspice{'_mobile' if law == 'mobile' else ''}.lib"]
    tran = f".tran {step!r} {1.5 * PERIOD!r}{extra}{' uic' if uic else ''}"
    text = "\n".join([*head, *lines, tran, rng.choice(("", ".ac dec 5 10 100k", ".options reltol=1e-5")), ".end"])
    circuit = quietly(fs.parse_netlist, text)
    if kind == "python":
        # A waveform that no netlist has, in place of the first source.
        first = circuit.by_device("V", "I")[0]
        a = volts * (1.0 if first.device == "V" else 2e-6)
        t = PERIOD * rng.uniform(0.1, 0.3)
        waveforms = (
            fs.Pulse(0.0, a, t, t, t, 0.0, 4.0 * t),
            fs.Pulse(-a, a, t, 0.0, 0.0, 3.0 * t, 3.0 * t),
            fs.Chirp(a, 0.5 / PERIOD, 3.0 / PERIOD, PERIOD),
            fs.Sine(a, 1.0 / PERIOD) * fs.Triangle(1.0, 0.5 / PERIOD),
            fs.Sawtooth(a, 2.0 / PERIOD),
        )
        circuit = circuit.replace({first.name: rng.choice(waveforms)})
    return f"{network}, {kind}, {law}", circuit, law
