"""Coefficients of the steppers: explicit Runge-Kutta pairs and Radau collocation.

A method is its numbers: nodes, weights, error weights and the polynomial of its dense output. Each tableau is
checked against its order conditions by the test suite.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre, polynomial
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Tableau:
    """One stepper.

    Parameters
    ----------
    name : str
        Name in the registry.
    order : int
        Order of the solution at the end of a step.
    dense_order : int
        Order of the dense output inside a step.
    error_order : int
        Exponent of h in the local error that steers the step.
    implicit : bool
        Whether the stages are solved for together (stiffly accurate collocation).
    a : ndarray, shape (s, s)
        Stage weights; for an explicit method strictly lower triangular, rows past the step's own stages
        serve the dense output.
    c : ndarray, shape (s,)
        Stage times in units of the step.
    e : ndarray, shape (2, s)
        Error weights: the estimate itself and, where its row is not zero, the lower-order companion that
        scales it (DOP853).
    dense : ndarray, shape (s, k)
        x(t + theta h) = x + h sum_i sum_j K_i dense[i, j] theta^(j + 1).
    n_end : int
        Number of the stage that equals the end of the step.
    """

    name: str
    order: int
    dense_order: int
    error_order: int
    implicit: bool
    a: FloatArray
    c: FloatArray
    e: FloatArray
    dense: FloatArray
    n_end: int


def _matrix(rows: tuple[tuple[float, ...], ...], width: int) -> FloatArray:
    out = np.zeros((len(rows), width))
    for i, row in enumerate(rows):
        out[i, : len(row)] = row
    return out


# Dormand and Prince, J. Comput. Appl. Math. 6 (1980) 19-26; dense output after Shampine, Math. Comp. 46 (1986).
_DP5_A = (
    (),
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
_DP5_E = (-71 / 57600, 0.0, 71 / 16695, -71 / 1920, 17253 / 339200, -22 / 525, 1 / 40)
_DP5_DENSE = (
    (1.0, -8048581381 / 2820520608, 8663915743 / 2820520608, -12715105075 / 11282082432),
    (0.0, 0.0, 0.0, 0.0),
    (0.0, 131558114200 / 32700410799, -68118460800 / 10900136933, 87487479700 / 32700410799),
    (0.0, -1754552775 / 470086768, 14199869525 / 1410260304, -10690763975 / 1880347072),
    (0.0, 127303824393 / 49829197408, -318862633887 / 49829197408, 701980252875 / 199316789632),
    (0.0, -282668133 / 205662961, 2019193451 / 616988883, -1453857185 / 822651844),
    (0.0, 40617522 / 29380423, -110615467 / 29380423, 69997945 / 29380423),
)

# DOP853: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I (1993), II.5 and II.6.
_C = (
    0.0,
    0.05260015195876773,
    0.0789002279381516,
    0.1183503419072274,
    0.2816496580927726,
    0.3333333333333333,
    0.25,
    0.3076923076923077,
    0.6512820512820513,
    0.6,
    0.8571428571428571,
    1.0,
    1.0,
    0.1,
    0.2,
    0.7777777777777778,
)
_A = (
    (),
    (0.05260015195876773,),
    (0.0197250569845379, 0.0591751709536137),
    (0.02958758547680685, 0.0, 0.08876275643042054),
    (0.2413651341592667, 0.0, -0.8845494793282861, 0.924834003261792),
    (0.037037037037037035, 0.0, 0.0, 0.17082860872947386, 0.12546768756682242),
    (0.037109375, 0.0, 0.0, 0.17025221101954405, 0.06021653898045596, -0.017578125),
    (
        0.03709200011850479,
        0.0,
        0.0,
        0.17038392571223998,
        0.10726203044637328,
        -0.015319437748624402,
        0.008273789163814023,
    ),
    (
        0.6241109587160757,
        0.0,
        0.0,
        -3.3608926294469414,
        -0.868219346841726,
        27.59209969944671,
        20.154067550477894,
        -43.48988418106996,
    ),
    (
        0.47766253643826434,
        0.0,
        0.0,
        -2.4881146199716677,
        -0.590290826836843,
        21.230051448181193,
        15.279233632882423,
        -33.28821096898486,
        -0.020331201708508627,
    ),
    (
        -0.9371424300859873,
        0.0,
        0.0,
        5.186372428844064,
        1.0914373489967295,
        -8.149787010746927,
        -18.52006565999696,
        22.739487099350505,
        2.4936055526796523,
        -3.0467644718982196,
    ),
    (
        2.273310147516538,
        0.0,
        0.0,
        -10.53449546673725,
        -2.0008720582248625,
        -17.9589318631188,
        27.94888452941996,
        -2.8589982771350235,
        -8.87285693353063,
        12.360567175794303,
        0.6433927460157636,
    ),
    (
        0.054293734116568765,
        0.0,
        0.0,
        0.0,
        0.0,
        4.450312892752409,
        1.8915178993145003,
        -5.801203960010585,
        0.3111643669578199,
        -0.1521609496625161,
        0.20136540080403034,
        0.04471061572777259,
    ),
    (
        0.056167502283047954,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        0.25350021021662483,
        -0.2462390374708025,
        -0.12419142326381637,
        0.15329179827876568,
        0.00820105229563469,
        0.007567897660545699,
        -0.008298,
    ),
    (
        0.03183464816350214,
        0.0,
        0.0,
        0.0,
        0.0,
        0.028300909672366776,
        0.053541988307438566,
        -0.05492374857139099,
        0.0,
        0.0,
        -0.00010834732869724932,
        0.0003825710908356584,
        -0.00034046500868740456,
        0.1413124436746325,
    ),
    (
        -0.42889630158379194,
        0.0,
        0.0,
        0.0,
        0.0,
        -4.697621415361164,
        7.683421196062599,
        4.06898981839711,
        0.3567271874552811,
        0.0,
        0.0,
        0.0,
        -0.0013990241651590145,
        2.9475147891527724,
        -9.15095847217987,
    ),
)
_E3 = (
    -0.18980075407240762,
    0.0,
    0.0,
    0.0,
    0.0,
    4.450312892752409,
    1.8915178993145003,
    -5.801203960010585,
    -0.4226823213237919,
    -0.1521609496625161,
    0.20136540080403034,
    0.02265179219836082,
    0.0,
)
_E5 = (
    0.01312004499419488,
    0.0,
    0.0,
    0.0,
    0.0,
    -1.2251564463762044,
    -0.4957589496572502,
    1.6643771824549864,
    -0.35032884874997366,
    0.3341791187130175,
    0.08192320648511571,
    -0.022355307863886294,
    0.0,
)
_D = (
    (
        -8.428938276109013,
        0.0,
        0.0,
        0.0,
        0.0,
        0.5667149535193777,
        -3.0689499459498917,
        2.38466765651207,
        2.117034582445028,
        -0.871391583777973,
        2.2404374302607883,
        0.6315787787694688,
        -0.08899033645133331,
        18.148505520854727,
        -9.194632392478356,
        -4.436036387594894,
    ),
    (
        10.427508642579134,
        0.0,
        0.0,
        0.0,
        0.0,
        242.28349177525817,
        165.20045171727028,
        -374.5467547226902,
        -22.113666853125306,
        7.733432668472264,
        -30.674084731089398,
        -9.332130526430229,
        15.697238121770845,
        -31.139403219565178,
        -9.35292435884448,
        35.81684148639408,
    ),
    (
        19.985053242002433,
        0.0,
        0.0,
        0.0,
        0.0,
        -387.0373087493518,
        -189.17813819516758,
        527.8081592054236,
        -11.57390253995963,
        6.8812326946963,
        -1.0006050966910838,
        0.7777137798053443,
        -2.778205752353508,
        -60.19669523126412,
        84.32040550667716,
        11.99229113618279,
    ),
    (
        -25.69393346270375,
        0.0,
        0.0,
        0.0,
        0.0,
        -154.18974869023643,
        -231.5293791760455,
        357.6391179106141,
        93.40532418362432,
        -37.45832313645163,
        104.0996495089623,
        29.8402934266605,
        -43.53345659001114,
        96.32455395918828,
        -39.17726167561544,
        -149.72683625798564,
    ),
)


def _dop853() -> Tableau:
    n = 16
    a = _matrix(_A, n)
    b = a[12]
    rows = np.zeros((7, n))
    rows[0] = b
    rows[1] = -b
    rows[1, 0] += 1.0
    rows[2] = 2.0 * b
    rows[2, 0] -= 1.0
    rows[2, 12] -= 1.0
    rows[3:] = _matrix(_D, n)
    dense = np.zeros((n, 7))
    basis = np.array([1.0])
    for i, row in enumerate(rows):
        # theta, theta (1 - theta), theta^2 (1 - theta), ...
        basis = polynomial.polymul(basis, [0.0, 1.0] if i % 2 == 0 else [1.0, -1.0])
        dense[:, : basis.size - 1] += np.outer(row, basis[1:])
    e = np.zeros((2, n))
    e[0, :13] = _E5
    e[1, :13] = _E3
    return Tableau("dop853", 8, 7, 8, False, a, np.array(_C), e, dense, 12)


def _dp5() -> Tableau:
    a = _matrix(_DP5_A, 7)
    c = np.array([0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0])
    e = np.zeros((2, 7))
    e[0] = _DP5_E
    return Tableau("dp5", 5, 4, 5, False, a, c, e, np.array(_DP5_DENSE), 6)


def radau(stages: int) -> Tableau:
    """Radau IIA collocation with `stages` nodes: order 2 s - 1, stiffly accurate, L-stable."""
    s = stages
    # Nodes: roots of P_s - P_{s-1} mapped to (0, 1]; the last is 1.
    coefficients = np.zeros(s + 1)
    coefficients[s - 1 :] = -1.0, 1.0
    roots = np.sort(legendre.legroots(coefficients).real)
    for _ in range(3):
        roots -= legendre.legval(roots, coefficients) / legendre.legval(roots, legendre.legder(coefficients))
    c = 0.5 * (roots + 1.0)
    c[-1] = 1.0
    # The derivative is the interpolant of the stages; its integral is the dense output.
    power = np.linalg.inv(np.vander(c, increasing=True))
    dense = (power / np.arange(1.0, s + 1.0)[:, None]).T
    a = (np.vander(c, s, increasing=True) * c[:, None]) @ dense.T
    # Error of the collocation polynomial: its highest Legendre coefficient, the part a polynomial of one
    # degree less could not follow.
    top = np.zeros((s + 1, s))
    top[1:] = dense.T
    shifted = np.array([legendre.poly2leg(_on_symmetric_interval(top[:, i]))[s] for i in range(s)])
    e = np.zeros((2, s))
    e[0] = shifted
    return Tableau(f"radau{2 * s - 1}", 2 * s - 1, s, s, True, a, c, e, dense, s - 1)


def _on_symmetric_interval(coefficients: FloatArray) -> FloatArray:
    """Coefficients in x of a polynomial given in theta = (1 + x) / 2."""
    out = np.zeros(1)
    for value in coefficients[::-1]:
        out = polynomial.polyadd(polynomial.polymul(out, [0.5, 0.5]), [value])
    full = np.zeros(coefficients.size)
    full[: out.size] = out
    return full


TABLEAUS: dict[str, Tableau] = {t.name: t for t in (_dp5(), _dop853(), radau(5))}
"""Own steppers by name: add a tableau here, and the tests and benchmarks pick it up."""
