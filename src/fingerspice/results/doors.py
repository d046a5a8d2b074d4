"""Methods of a solution that show it: each calls an upper part, which is loaded only then."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from fingerspice.base.pages import Shown

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike

    from fingerspice.results.sensitivity import SampleGradient
    from fingerspice.results.solution import Solution
    from fingerspice.sets.parameters import Citation


class Doors(Shown):
    """What a solution shows of itself."""

    def plot(
        self,
        signals: str | Sequence[str] | None = None,
        *,
        window: tuple[float, float] | None = None,
        others: Solution | Sequence[Solution] | Mapping[str, Solution] = (),
    ) -> Figure:
        """Draw signals against time: a notebook shows the figure, and from a script ``plot().show()`` opens a window.

        More than about 30 oscillations are drawn as envelopes, and a second column shows the last few of them enlarged;
        it also shows a short event enlarged.

        Parameters
        ----------
        signals : str or sequence of str, optional
            Keys of `signals`, such as ``"f_el"``, ``"u_layer:Xcoat"``, or ``"u_layer"`` for all layers; signals of the
            same quantity share a panel. The default is source and gap voltage, force, area and friction.
        window : tuple of float, optional
            Start and end, s; the whole run by default.
        others : Solution, sequence or mapping of str to Solution, optional
            Runs to draw over this one; without names they are called by the facts in which they differ.

        Returns
        -------
        matplotlib.figure.Figure
            ``savefig("x.pdf")`` saves it, ``show()`` shows it.

        Raises
        ------
        InputError
            For an unknown signal, or a window without outputs.
        """
        from fingerspice.plots.traces import plot_solution

        return plot_solution(self, signals, window, others)  # type: ignore[arg-type]

    def explore(self) -> Any:
        """Show the run's circuit on a local page as it was run, in a notebook below the cell (docs/explore.md).

        Returns
        -------
        Explorer
            The running page.
        """
        from fingerspice.explorer.server import explore

        return explore(self)  # type: ignore[arg-type]

    def sample_gradient(self, **of: ArrayLike) -> SampleGradient:
        """Derivatives of a number that follows from this run by every sample of its source (docs/sensitivities.md).

        For ``J = sum((run.f_t - wanted) ** 2)`` that is ``run.sample_gradient(f_t=2.0 * (run.f_t - wanted))``. The run
        has one GAP whose area follows its voltage, under one recording: `Samples`, or a PWL on an even grid. One way
        back through the run's steps gives the derivatives by all samples.

        Parameters
        ----------
        **of : array_like
            Derivatives of J by signals of the run, shape (n_t,): ``u_gap``, ``area``, ``f_el``, ``f_t``, ``friction``;
            and by its means, numbers: ``area_mean``, ``f_el_mean``, ``f_t_mean``, ``friction_mean``.

        Returns
        -------
        SampleGradient
            Shape (n_sample,), with the error stated.

        Raises
        ------
        InputError
            For another circuit, source or run, or an unknown signal.
        SolveError
            If the run cannot be followed sample by sample.
        """
        from fingerspice.solve.adjoint import sample_gradient

        return sample_gradient(self, of)  # type: ignore[arg-type]

    def cite(self) -> Citation:
        """What to cite for this run: the model's paper, the program, and the sets of parameters that were applied.

        Returns
        -------
        Citation
            ``print`` shows the text and the BibTeX, which is also in `Citation.bibtex`.
        """
        from fingerspice.sets.parameters import cite

        return cite(self.circuit, self.method)  # type: ignore[attr-defined]
