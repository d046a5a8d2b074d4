"""Wrong decks: every error is one clear sentence with the place, the given text and the allowed alternatives."""

from __future__ import annotations

from pathlib import Path

import pytest

import fingerspice as fs
from deck_edits import edited

# What is wrong: (change, line or 0 for the file, what the message must hold)

SIN, TRAN = "SIN(0 200 100)", ".tran 10u 50m uic"

DEVICES = [
    (("eps_r=3.9", "epsr=3.9"), 4, ["Xcoat: LAYER has no parameter 'epsr'", "did you mean 'eps_r'", "d, eps_r, r"]),
    (("m_exp=0.52", "m=0.52"), 5, ["GAP has no parameter 'm'; the exponent is m_exp"]),
    (("GAP", "GPA"), 5, ["'GPA'", "did you mean 'GAP'"]),
    (("LAYER", "RESISTOR"), 4, ["'RESISTOR' is not a device", "devices are LAYER SLAB SKIN"]),
    (("Xgap top skin area", "Xgap top skin"), 5, ["GAP has 3 nodes (p n area), 2 given"]),
    (("Xgap top", "gap top"), 5, ["a device's name begins with X, as in Xgap"]),
    (("Xcoat", "Lcoat"), 4, ["a device's name begins with X"]),
    (("d=1u", ""), 4, ["Xcoat: LAYER needs d (m), missing here"]),
    (("d=1u", "d="), 4, ["missing value of 'd'"]),
    (("d=3.5u", "d=3,5u"), 5, ["'5u' follows", "3,5u is two numbers, 3 and 5u", "write 3.5u"]),
    (("d=3.5u", "d=3.5 µ"), 5, ["'µ' follows", "a unit joins its number, 3.5µ"]),
    (("d=3.5u", "d=1e−6"), 5, ["its minus is a typographic one: write 1e-6"]),
    (("f=100", ""), 6, ["Xskin: SKIN needs f (Hz), missing here"]),
    (("LAYER d=1u eps_r=3.9 r=0.2meg", "SLAB d=1u eps_r=3.9"), 4, ["SLAB needs rho (ohm m), missing here"]),
    (("SKIN d=350u f=100", "SKIN_DISPERSIVE d=350u f=100"), 6, ["SKIN_DISPERSIVE has no parameter 'f'"]),
    (("c2=5000", "c2=5000 tau=-1m"), 5, ["Xgap tau is -1m (-0.001 s); allowed: 0 or more"]),
    (("r=0.2meg", "e_max=0"), 4, ["Xcoat e_max is 0 V/m", "more than 0 or inf"]),
]

VALUES = [
    (("d=1u", "d=-1u"), 4, ["Xcoat d is -1u (-1e-06 m); allowed: more than 0"]),
    (("d=1u", "d=0"), 4, ["Xcoat d is 0 m; allowed: more than 0"]),
    (("d=350u", "d={-350u}"), 6, ["Xskin d is {-350u} (-0.00035 m); allowed: more than 0"]),
    (("d=1u", "d=inf"), 4, ["Xcoat d is 'inf'; allowed: a number m"]),
    (("d=1u", "d=thick"), 4, ["Xcoat d is 'thick'; allowed: a number m, or the name of a .param"]),
    (("mu=0.3", "mu=30%"), 5, ["'30%' is not a number: write 0.3"]),
    (("d=1u", "d=1 um"), 4, ["'um' follows the parameters"]),
    (("eps_r=3.9", "eps_r=0"), 4, ["Xcoat eps_r is 0; allowed: more than 0"]),
    (("r=0.2meg", "r=-5"), 4, ["Xcoat r is -5 ohm; allowed: more than 0 or inf"]),
    (("r=0.2meg", "r=0"), 4, ["Xcoat r is 0 ohm; allowed: more than 0 or inf"]),
    (("r=0.2meg", "r=2k7"), 4, ["'2k7' differs between simulators: write 2.7k"]),
    (("r=0.2meg", "r=0.2x"), 4, ["'0.2x' differs between simulators", "write 0.2meg"]),
    (("r=0.2meg", "r=1a"), 4, ["'1a' differs between simulators"]),
    (("d=1u", "d=1micron"), 4, ["'1micron' would be read as 1m (milli): write 1u"]),
    (("f=100", "f=0"), 6, ["Xskin f is 0 Hz; allowed: more than 0"]),
    (("fn=0.5", "fn=0.5N"), 5, ["Xgap fn is '0.5N': SPICE reads N as nano (1e-9)", "alone, in newton"]),
    (("fn=0.5", "fn=0.5newton"), 5, ["SPICE reads N as nano"]),
    (("fn=0.5", "fn=0"), 5, ["Xgap fn is 0 N; allowed: more than 0"]),
    (("mu=0.3", "mu=-0.3"), 5, ["Xgap mu is -0.3; allowed: 0 or more"]),
    (("c2=5000", "c2=5000 a_fix=-1"), 5, ["Xgap a_fix is -1 mm^2; allowed: 0 or more"]),
    (("d=1u", "d=1e-40"), 4, ["Xcoat d is 1e-40 m; allowed: more than 0, from 1e-30 to 1e+30"]),
    (("r=0.2meg", "r=1e31"), 4, ["Xcoat r is 1e31 (1e+31 ohm); allowed: more than 0 or inf, from 1e-30 to 1e+30"]),
    (("f=100", "f=1e300"), 6, ["Xskin f is 1e300 (1e+300 Hz); allowed: more than 0, from 0.001 to 1e+09"]),
    (("eps_r=3.9", "eps_r={3/0}"), 4, ["'3/0' divides by zero"]),
    (("eps_r=3.9", "eps_r={er}"), 4, ["'er' is not defined"]),
    (("eps_r=3.9", "eps_r={__import__(1)}"), 4, ["__import__"]),
    (("eps_r=3.9", "eps_r={[1][0]}"), 4, ["["]),
    (("eps_r=3.9", "eps_r={3.9"), 4, ["'{' is never closed"]),
    (("eps_r=3.9", "eps_r=(3.9)"), 4, ["arithmetic goes in braces"]),
    ((".end", "C1 drive 0 1F"), 8, ["C1 value is '1F': SPICE reads F as femto (1e-15)", "alone, in farad"]),
    ((".end", "C1 drive 0 1farad"), 8, ["SPICE reads F as femto"]),
    ((".end", "C1 drive 0 0"), 8, ["C1 value is 0 F; allowed: more than 0"]),
    ((".end", "C1 drive 0 -1u"), 8, ["C1 value is -1u (-1e-06 F); allowed: more than 0"]),
    ((".end", "C1 drive 0 1u ic=x"), 8, ["C1 IC is 'x'; allowed: a number V"]),
    ((".end", "R1 drive 0 -1k"), 8, ["R1 value is -1k (-1000 ohm); allowed: more than 0"]),
    ((".end", "R1 drive 0 0"), 8, ["R1 value is 0 ohm; allowed: more than 0"]),
    ((".end", "R1 drive 0 1k 2k"), 8, ["R1 needs one value in ohm, 2 are given"]),
    ((".end", "R1 drive 0 1k r=2k"), 8, ["R1 needs one value in ohm, 2 are given"]),
    ((".end", "R1 drive 0 tol=1"), 8, ["R1 needs one value in ohm, 0 are given"]),
    ((".end", "R1 drive 0 3,5k"), 8, ["R1 needs one value", "decimal comma write 3.5k"]),
    ((".end", "R1 drive 0 1k tc=1"), 8, ["R1 takes no parameter 'tc'; allowed: r=, resistance=, m=, tol=, pwr="]),
    ((".end", "R1 drive 0 1k m=0"), 8, ["R1 m is '0'; allowed: a number of parts side by side"]),
    ((".end", "C1 drive 0 1u lser=1n"), 8, ["C1 takes no parameter 'lser', there are no inductors here; allowed: c="]),
    ((".end", "C1 drive 0 1u rser=-1"), 8, ["C1.Rser value is -1 ohm; allowed: more than 0"]),
    ((".end", "C1 drive 0 1u rpar=0"), 8, ["C1.Rpar value is 0 ohm; allowed: more than 0"]),
]

CONTACT = [
    (("mu=0.3", "mu=2"), 5, ["Xgap has no contact", "37.94 mm^2", "70.71 mm^2", "A0^2 > c2 mu^2 fn^2"]),
    (("m_exp=0.52", "m_exp=1.5"), 5, ["Xgap exponents are m_exp=1.5, n_exp=1.41; allowed: 0 < m_exp < n_exp"]),
    (("m_exp=0.52", "m_exp=1.41"), 5, ["allowed: 0 < m_exp < n_exp"]),
    (("m_exp=0.52", "m_exp=-1"), 5, ["Xgap m_exp is -1; allowed: more than 0"]),
    (("n_exp=1.41", "n_exp=1000"), 5, ["Xgap has a contact whose constants are beyond the range",
     "nearer to Table 1's"]),
    (("m_exp=0.52 beta=32 n_exp=1.41", "m_exp=3 beta=32 n_exp=4"), 5, ["1/m + 1/n = 0.5833; allowed: more than 1"]),
]  # fmt: skip

CIRCUIT = [
    (("Vdrive drive 0 SIN(0 200 100)", "*"), 0, ["the circuit has no source; allowed: a V element"]),
    (("Xskin skin 0", "Xskin skn 0"), 5, ["node 'skin' is floating: only Xgap touches it", "is 'skn' the same node?"]),
    (("Xskin skin 0", "Xskin skin gnd1"), 6, ["node 'gnd1' is floating", "ground is 0 or gnd"]),
    (("Xskin skin 0 area", "Xskin skin 0 0"), 6, ["Xskin has ground as its area; allowed: the area node of a GAP"]),
    (("Xskin skin 0", "Xskin skin far"), 6, ["node 'far' is floating: only Xskin touches it"]),
    (("Xskin skin 0", "Xskin skin skin"), 6, ["Xskin has both ends on node 'skin'"]),
    (("0 area SKIN", "0 aera SKIN"), 6, ["node 'aera' gives Xskin its area, but no GAP and no DC source drives it",
     "Xgap drives 'area'"]),
    (("Xcoat", "Xgap"), 5, ["element 'Xgap' is defined twice, first at deck.cir:4:1"]),
    ((".end", "Vb drive 0 5"), 8, ["Vdrive and Vb are voltage sources in parallel"]),
    (("Xskin skin 0 area SKIN d=350u f=100", edited().split("\n")[4].replace("Xgap top skin", "Xgap2 skin 0")), 6,
     ["deck.cir:6:1: Xgap and Xgap2 both drive the area node 'area'; allowed: one GAP per area"]),
    ((".end", "Va area 0 35"), 8, ["Va and Xgap both drive the area node 'area'", "allowed: a_fix= on Xgap"]),
    ((".end", "R1 drive loose 1k"), 8, ["node 'loose' is floating: only R1 touches it"]),
    ((".end", ".subckt a p\n.ac dec 1 1 2"), 9,
     ["inside .subckt a, which begins at deck.cir:8:1; is its .ends missing?"]),
    ((".end", ".param w=3,5u"), 8, ["',' outside the arguments", "decimal comma write 3.5u"]),
    ((".end", "# note"), 8, ["'#' is no element", "a comment with *"]),
    ((".end", "B1 drive 0 V=5*time"), 8, ["a behavioural source (a function of time is given in Python"]),
    ((".end", "D1 drive 0 diode"), 8, ["'D1' is a diode, which is not supported"]),
]  # fmt: skip

DIRECTIVES = [
    ((TRAN, ".tran 10u 0"), 7, ["TSTOP is 0; allowed: more than 0 s"]),
    ((TRAN, ".tran 10u -50m"), 7, ["TSTOP is -50m; allowed: more than 0 s"]),
    ((TRAN, ".tran 0 50m startup"), 7, [".tran startup: sources are not ramped up here"]),
    ((TRAN, ".tran -1u 50m"), 7, ["TSTEP is -1u; allowed: more than 0 s"]),
    ((TRAN, ".tran 0 50m 0 60m"), 7, ["TSTEP is 60m; allowed: at most TSTOP = 50m"]),
    ((TRAN, ".tran 50m 10u"), 7, ["TSTEP is 50m; allowed: at most TSTOP = 10u"]),
    ((TRAN, ".tran 1e-15 50m"), 7, ["TSTEP is 1e-15; allowed: at most 1e8 output steps"]),
    ((TRAN, ".tran 10u 50m 60m"), 7, ["TSTART is 60m; allowed: 0 to TSTOP = 50m"]),
    ((TRAN, ".tran 10u 50m -1m"), 7, ["TSTART is -1m; allowed: 0 to TSTOP = 50m"]),
    ((TRAN, ".tran 10u 50m 0 0"), 7, ["TMAX is 0; allowed: 1e-30 to 1e30 s"]),
    ((TRAN, ".tran 20 m"), 7, ["is not understood", "a unit joins its number, such as 20m"]),
    ((TRAN, ".tran uic"), 7, ["allowed: .tran TSTEP TSTOP [TSTART [TMAX]] [uic]"]),
    ((TRAN, ".tran 0"), 7, ["TSTOP is 0; allowed: more than 0 s"]),
    ((TRAN, ".tran 10u 0,05"), 7, ["TSTOP is 0;", "if it is a decimal comma write 0.05"]),
    ((TRAN, ".tran 10u 50m 0 1u 3"), 7, ["allowed: .tran TSTEP TSTOP"]),
    ((TRAN, ".tran 10u 50m uci"), 7, ["'.tran 10u 50m uci' is not understood", "[uic]"]),
    ((TRAN, ".tran stop=50m"), 7, [".tran takes no 'stop'"]),
    ((TRAN, ".trans 10u 50m"), 7, [".trans is not supported; did you mean '.tran'"]),
    ((".end", ".tran 1u 1m"), 8, [".tran is given twice, first at deck.cir:7:1"]),
    ((".end", ".ac dec 10 1"), 8, ["allowed: .ac DEC|OCT|LIN N FSTART FSTOP"]),
    ((".end", ".ac log 10 1 2"), 8, ["'.ac log 10 1 2' is not understood"]),
    ((".end", ".ac dec 0 1 2"), 8, ["N is 0; allowed: a whole number"]),
    ((".end", ".ac dec 2.5 1 2"), 8, ["N is 2.5; allowed: a whole number"]),
    ((".end", ".ac dec 10 0 2"), 8, ["FSTART is 0; allowed: more than 0 Hz"]),
    ((".end", ".ac dec 10 20 2"), 8, ["FSTOP is 2; allowed: at least FSTART = 20"]),
    ((".end", ".ic top=3"), 8, [".ic 'top' is not understood; allowed: .ic v(node)=value"]),
    ((".end", ".ic v(top) 3"), 8, ["'.ic v(top) 3' is not understood; allowed: .ic v(node)=value"]),
    ((".end", ".ic 3"), 8, ["'.ic 3' is not understood"]),
    ((".end", ".ic v(top)=x"), 8, [".ic v(top) is 'x'; allowed: a number V"]),
    ((".end", ".ic v(tpo)=1"), 8, ["node 'tpo', which is not in the circuit; did you mean 'top'"]),
    ((".end", ".ic v(top)=1\n.ic v(TOP)=2"), 9, [".ic gives node 'top' twice"]),
    ((".end", ".ic v(0)=1"), 8, [".ic v(0) is 1 V; allowed: 0, it is ground"]),
    ((".end", ".options work=both"), 8, [".options work is 'both'; allowed: gap or total"]),
    ((".end", ".options work=gap work2=1"), 8, ["unknown option 'work2'; did you mean 'work'"]),
    ((".end", ".options work=gap\n.options work=total"), 9, ["work is given twice, first gap, then total"]),
    ((".end", ".options dialect=ngspice"), 8, ["unknown option 'dialect'; allowed: work=gap|total"]),
    ((".end", ".options 5"), 8, [".options '5' is not understood; allowed: .options name=value"]),
]

SOURCES = [
    ((SIN, "SIN(0 200 100"), 3, ["'(' is never closed"]),
    ((SIN, "SIN(0 200 2k7)"), 3, ["write 2.7k"]),
    ((SIN, "PWL(0 0 2m 1 1m 2)"), 3, ["Vdrive: PWL times decrease: 0.001 s follows 0.002 s"]),
    ((SIN, "PWL(0 0 1m nan)"), 3, ["PWL value is 'nan'; allowed: a number"]),
    ((SIN, "PWL(0 0 nan 1)"), 3, ["PWL value is 'nan'; allowed: a number"]),
    ((SIN, "PWL(1e28 0 -1e28 1)"), 3, ["PWL times decrease: -1e+28 s follows 1e+28 s"]),
    ((SIN, "AM(1 2 3 4)"), 3, ["Vdrive: AM changed its argument order"]),
    ((SIN, "SFFM(0 1 2 3 4)"), 3, ["Vdrive: SFFM changed its argument order"]),
    ((SIN, "WAVEFILE(a.wav 1)"), 3, ["'a.wav' does not exist"]),
    ((SIN, "TABLE(a.csv)"), 3, ["'a.csv' does not exist"]),
    ((SIN, "PWL file=a.txt"), 3, ["'a.txt' does not exist"]),
    ((SIN, "SINE(0 200 100 0 0 0 5)"), 3, ["SINE takes at most 6", "Ncycles is not supported"]),
    ((SIN, "SIN(0 200 100 r=0)"), 3, ["SIN has no parameter 'r'; allowed: SIN(VO VA FREQ TD THETA PHASE)"]),
    ((SIN, "SQUARE(9 1 duty=.2)"), 3, ["SQUARE has no parameter 'duty'; allowed: SQUARE(amplitude"]),
    ((SIN, "PULSE(0 1 0 1u 1u 1m 2m 5)"), 3, ["PULSE takes at most 7", "Ncycles is not supported"]),
    ((SIN, "SIN(0 200 100) Lser=1"), 3, ["Vdrive takes no parameter 'lser'; allowed: Rser, Cpar"]),
    ((SIN, "SIN(0 200 100 0 0 90°)"), 3, ["'90°' is not a number: write 90"]),
    ((SIN, "200*sin(2*pi*100*t)"), 3, ["in braces"]),
    ((SIN, "sin(2*pi*100*t)"), 3, ["a function of time is SIN(VO VA FREQ), PULSE or PWL"]),
    ((SIN, "SIN 0 200 5 k"), 3, ["'k' stands apart; a unit joins its number"]),
    ((SIN, "200 100"), 3, ["a second value '100'", "such as SIN(0 200 100)"]),
    ((SIN, "SIN(0 200 0,1)"), 3, ["frequency is 0 Hz", "0,1 is two numbers", "write 0.1"]),
    ((SIN, ""), 3, ["missing value", "Vdrive node node value"]),
]

BAD = [*DEVICES, *VALUES, *CONTACT, *CIRCUIT, *DIRECTIVES, *SOURCES]


@pytest.mark.parametrize(("change", "line", "parts"), BAD, ids=lambda x: x[1] if isinstance(x, tuple) else "")
def test_what_is_wrong_is_a_sentence_with_its_line(change: tuple[str, str], line: int, parts: list[str]) -> None:
    with pytest.raises(fs.InputError) as caught:
        fs.parse_netlist(edited(change), "deck.cir")
    said = str(caught.value)
    assert said.startswith(f"deck.cir:{line}:" if line else "deck.cir: ")
    for part in parts:
        assert part in said
    assert "\n" not in said
    assert len(said) < 400


def test_a_refused_file_is_named_by_its_path(tmp_path: Path) -> None:
    path = tmp_path / "finger pad.cir"
    path.write_text(edited(("d=1u", "d=-1u")))
    with pytest.raises(fs.InputError) as caught:
        fs.read_netlist(path)
    assert str(caught.value).startswith(f"{path}:4:30: ")
