"""Some of the random scenes of `stress.py`; `make stress` tests ten thousand."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
import stress
from scenes import cases

FIRST = 60


@pytest.mark.parametrize("number", range(FIRST, FIRST + cases(60, 8)))
def test_a_random_scene_is_right_or_refused_for_a_true_reason(number: int) -> None:
    assert stress.judge(stress.draw(0, number))


# Scenes that were once wrong, or took minutes: seed and number.
MENDED = {
    (0, 24): "refused: fold",  # Charge opposes the source: the voltage falls from 44 kV to 19 V before its branch ends.
    (0, 37): "refused: fold",  # A jump past the kink at 0 V, where charge holds the area's branch no longer.
    (0, 51): "right",  # What decays after a jump is faster than the rounding of the time.
    (0, 58): "refused: fold",  # The kink itself: the voltage comes down to 0 V, and no voltage leads on.
    (0, 185): "right",  # Stiff, and the area moves the fast mode: short steps only converge.
    (0, 186): "refused: fold",  # A fold on a mode five million times faster than what leads to it.
    (0, 231): "right",  # The gap takes so little that every step is longer than its error asks for.
    (0, 807): "right",  # As 185, under `local`.
    (0, 661): "refused: fold",  # Newton, or a walk, went over a fold to another root: a result where there is none.
    (0, 1730): "refused: fold",  # As 661.
    (0, 8277): "right",  # An iteration that had not closed turned the branch round, and a zero was stepped over.
    (4, 394): "right",  # Decays after a jump below the rounding of the time, by Radau.
    (0, 2608): "right",  # Radau's Newton met no slope of the area equation from the start of a step, but at its end.
    (0, 3964): "refused: fold",  # Radau stepped over the fold, onto a branch half a period later.
    (0, 354): "right",  # Radau's tolerance was one of 1 V, however large the source.
    (0, 1969): "refused: fold",  # A gap voltage below rounding went over the fold: the steps' end was taken for it.
    (0, 1204): "refused: fold",  # The path to a fold is followed only at a loose tolerance, for a fast leak's rounding.
    (33, 1501): "refused: fold",  # A jump to next to no area, as in 124 and 2759 below.
    (21, 2546): "right",  # Radau's scale of the charge was that of an area that a volt presses away.
    (0, 1839): "right",  # The reference's own: a current behind 6 milliohm,
    (0, 1850): "right",  # and a peak close after a late edge.
    (0, 2529): "right",  # The charge's stated error left out what the polynomial of its rate misses.
    (0, 3978): "right",  # The force's peak was looked for on polynomials that missed it by 1e-6.
    (0, 4495): "right",  # The force's peak stood between the last two nodes of a panel.
    (0, 1304): "right",  # Runs were refused for the error of a node whose fast decay no gap feels.
    (0, 1596): "refused: fold",  # The path from where the steps had met the fold went back in time.
    # Their first step fits more than 2^63 times into the run: that number overflowed, and every step was of 0 s.
    **dict.fromkeys(((0, 2540), (0, 2975)), "right"),
    (0, 5806): "right",  # A gap took 1e-8 of the source, and so many digits of it as the source has were thought lost.
    (0, 3636): "refused: rounding",  # Implicit steps took 20 s though rounding alone was more than the error asked for.
    (0, 3546): "right",  # The error of a mode that no leak drains, of 1e12 V, was carried by a difference of that size.
    (0, 3553): "refused: fold",  # The reference's own: its end of a step leapt past the fold.
    # Their gap voltage is near rounding of the source's, and a fold ends them.
    **dict.fromkeys(((3, 12), (3, 68), (3, 214)), "refused: fold"),
}
# Others of these kinds, of which the first jumps to an area of 4.5e-13 m^2 past no fold, and in 4371 a sum of voltages
# that turned was taken for a zero of the gap's, and in 3581 a Radau run's polynomials were too coarse for its error.
OTHERS = {
    (4, 124): "right", (0, 4371): "refused: fold", (0, 650): "right", (0, 454): "refused: fold",
    (0, 761): "refused: fold", (1, 539): "right", (1, 299): "right", (0, 3773): "refused: fold",
    (3, 178): "refused: fold", (0, 5490): "right",
    (1, 920): "refused: fold", (1, 45): "refused: fold", (21, 2759): "right", (0, 1380): "right", (0, 1731): "right",
    (0, 1887): "right", (0, 3581): "right",
}  # fmt: skip


@pytest.mark.parametrize(("seed", "number"), [*MENDED, *list(OTHERS)[: cases(len(OTHERS), 0)]])
def test_a_scene_that_was_wrong_or_endless_is_mended(seed: int, number: int) -> None:
    assert stress.judge(stress.draw(seed, number)).end == (MENDED | OTHERS)[seed, number]


@pytest.mark.filterwarnings("ignore:.*breaks down")
@pytest.mark.parametrize("number", [2540, 2975])
def test_a_first_step_of_a_1e20th_of_the_run_is_an_exponential_one(number: int) -> None:
    scene = stress.draw(0, number)
    with np.errstate(all="ignore"):
        solution = fs.simulate(scene.circuit, charge_law=scene.law, rtol=1e-6, method="exponential")
        expected = scene.expected(solution.t).u_gap
    turns = 2.0 * scene.frequency * solution.t
    missed = np.abs(solution.u_gap - expected)[np.abs(turns - np.rint(turns)) > 1e-6]  # A jump has two sides.
    assert missed.max() <= stress.REFERENCE * scene.amplitude


def test_scenes_reach_over_twelve_decades_and_repeat() -> None:
    scenes = [stress.draw(0, k) for k in range(cases(2000, 500))]
    assert stress.draw(0, 7) == scenes[7]
    resistances = np.array([r for s in scenes for r in s.r if np.isfinite(r)])
    assert resistances.min() < 1e-2
    assert resistances.max() > 1e14
    for values, low, high in (
        ([s.amplitude for s in scenes], 1e-8, 1e4),
        ([s.frequency for s in scenes], 1e-2, 1e5),
        ([s.f_n for s in scenes], 1e-4, 10.0),
        ([d for s in scenes for d in s.d], 1e-8, 1e-4),
    ):
        assert min(values) < low
        assert max(values) > high
    assert all(0.0 < s.m < s.n and 1.0 / s.m + 1.0 / s.n > 1.0 for s in scenes)


def test_a_scene_judged_by_another_one_s_reference_is_wrong() -> None:
    scene = next(s for s in (stress.draw(0, k) for k in range(FIRST, FIRST + 60)) if s.touches and s.law == "local")

    @dataclasses.dataclass(frozen=True)
    class Another(stress.Scene):
        def expected(self, t, tol=1e-11):
            return dataclasses.replace(scene, amplitude=1.001 * scene.amplitude).expected(t, tol)

    with pytest.raises(stress.WrongError, match="u_gap is off by"):
        stress.judge(Another(**dataclasses.asdict(scene)))


@pytest.mark.parametrize(
    ("signal", "share", "said"),
    [("force", 1e-4, "f_el is off by"), ("area", 1e-4, "area is off by"), ("q", 1e-4, "q_source is off by"),
     ("q", 1e-5, "times what is stated"), ("force", 1e-11, ""), ("q", 1e-11, "")],
)  # fmt: skip
@pytest.mark.parametrize("number", [62, 67][: cases(2, 1)])
def test_force_area_charge_and_stated_errors_are_judged(number: int, signal: str, share: float, said: str) -> None:
    @dataclasses.dataclass(frozen=True)
    class Wrong(stress.Scene):
        def expected(self, t, tol=1e-11):
            run = super().expected(t, tol)
            return dataclasses.replace(run, **{signal: (1.0 + share) * getattr(run, signal)})

    scene = Wrong(**dataclasses.asdict(stress.draw(0, number)))
    if said:
        with pytest.raises(stress.WrongError, match=said):
            stress.judge(scene)
    else:
        assert stress.judge(scene).end == "right"


def test_the_counts_are_written_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "counts.json"
    assert stress.main(["--scenes", "3", "--first", "60", "--json", str(path)]) == 0
    found = json.loads(path.read_text())
    assert (found["seed"], found["first"], found["scenes"]) == (0, 60, 3)
    assert sum(found["counts"].values()) == 3
    assert found["wrong"] == {}
    right = found["counts"]["right"]
    assert right > 0
    for name in ("u_gap", "f_el", "q_source"):
        assert found["stated"][name]["judged"] == right
        assert found["stated"][name]["exceeded"] == len(found["stated"][name]["worst"])
    assert f"{right:7d} right" in capsys.readouterr().out
