"""Draw figures for reports with matplotlib."""

from __future__ import annotations

import functools
import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError
from lidarspec.optional_libraries import import_library
from lidarspec.points.appearance import CloudAppearance, find_bounds
from lidarspec.points.colours import make_ramp, to_hex
from lidarspec.scans.scan import Scan
from lidarspec.view.live_scans import LiveScans
from lidarspec.view.rate_meter import totals

#: supported suffixes of `save`.
SUFFIXES = (".png", ".pdf", ".svg")
#: width of a figure. The next constant is the height of one of its panels.
WIDTH_INCHES = 7.0
PANEL_INCHES = 4.2
#: minimum and maximum height of the side view.
MIN_SIDE_INCHES = 0.7
MAX_SIDE_INCHES = 3.0
DPI = 160
#: maximum number of bins of the intensity histogram. The next two constants are the number of bins
#: of the range axis, and the maximum number of bins of the time axis.
MAX_INTENSITY_BINS = 128
RANGE_BINS = 200
MAX_TIME_BINS = 400
#: minimum width of a bin of the time axis.
MIN_TIME_BIN_S = 0.1
#: the axis of ranges ends at this percentile of the ranges.
SHOWN_PERCENTILE = 99.8
#: number of steps of the colour ramp.
COLOUR_COUNT = 256
STYLE = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "svg.hashsalt": "lidarspec",  # identical figures have identical bytes
}

_Drawing = TypeVar("_Drawing", bound=Callable[..., Any])


def _with_style(draw: _Drawing) -> _Drawing:
    """Decorate a function so that it draws in the style of these figures."""

    @functools.wraps(draw)
    def drawn(*args: Any, **options: Any) -> Any:
        with import_library("matplotlib", "plot").rc_context(STYLE):
            return draw(*args, **options)

    return drawn  # type: ignore[return-value]


@_with_style
def save(figure: Any, target: Any, suffix: str) -> None:
    """Write a figure to a path or a binary file, in the format of a suffix."""
    figure.savefig(
        target,
        format=suffix.removeprefix("."),
        dpi=DPI,
        metadata={"Date": None} if suffix == ".svg" else None,
    )


@_with_style
def draw_scan(scan: Scan, look: CloudAppearance, title: str) -> Any:
    """Return a figure of a scan, seen from above and, if it is not flat, from the right side.

    Args:
        look: the extent of the view and the colours of the points, from `choose_appearance`.
    """
    cloud = scan.points[scan.points.valid]
    column: Any
    if look.ramp == "range":
        column = cloud.range
    elif look.ramp == "intensity":
        column = cloud.intensity
    else:
        column = cloud.extra[look.ramp]
    unit = "m" if look.ramp == "range" else look.unit
    lowest, highest = find_bounds(cloud)
    low = min(float(lowest[2]), 0.0)
    high = max(float(highest[2]), 0.0)
    if look.flat:
        tall = 0.0
    else:
        tall = float(
            np.clip(
                (high - low) / (2 * look.reach) * WIDTH_INCHES * 0.85,
                MIN_SIDE_INCHES,
                MAX_SIDE_INCHES,
            )
        )
    figure = _make_figure(title, WIDTH_INCHES * 0.92 + tall)
    rows = figure.subplots(
        1 if look.flat else 2,
        1,
        squeeze=False,
        height_ratios=[WIDTH_INCHES * 0.75, *[tall] * (not look.flat)],
    )[:, 0]
    dots = {
        "c": column,
        "cmap": make_colour_map(),
        "s": np.clip(20000 / max(len(cloud), 1), 0.4, 6),
        "linewidths": 0,
        "vmin": look.low,
        "vmax": look.full,
        "rasterized": True,
    }
    shown = rows[0].scatter(cloud.y, cloud.x, **dots)
    forward, left = look.middle
    seen = (forward - look.reach, forward + look.reach)
    rows[0].set(xlim=(left + look.reach, left - look.reach), ylim=seen, aspect="equal")
    rows[0].set(xlabel="y [m], left", ylabel="x [m], forward")
    rows[0].plot(0, 0, "k^", markersize=6)
    for side in rows[1:]:
        side.scatter(cloud.x, cloud.z, **dots)
        side.plot(0, 0, "k>", markersize=6)
        side.set(xlim=seen, ylim=(low - 0.1, high + 0.1), aspect="equal")
        side.set(xlabel="x [m], forward", ylabel="z [m], up")
    figure.colorbar(
        shown, ax=rows, label=f"{look.ramp} [{unit}]" if unit else look.ramp, shrink=0.6, pad=0.02
    )
    return figure


@_with_style
def draw_intensities(scans: Iterable[Scan], title: str) -> Any:
    """Return a figure with the histogram of the intensities.

    Raises:
        UsageError: if the sensor measures no intensity, or if no point is valid.
    """
    counted = Counter[float]()
    has_intensity = False
    for scan in scans:
        if scan.points.intensity is not None:
            has_intensity = True
            values, value_counts = np.unique(
                np.rint(scan.points.intensity[scan.points.valid]), return_counts=True
            )
            counted.update(dict(zip(values.tolist(), value_counts.tolist(), strict=True)))
    if not has_intensity:
        raise UsageError("the sensor measures no intensity")
    if not counted:
        raise UsageError("no point of the selected scans has a return in the selected range")
    strengths, counts = np.array(sorted(counted.items())).T
    middle = strengths[np.searchsorted(np.cumsum(counts), counts.sum() / 2)]
    figure = _make_figure(f"{title}: {int(counts.sum()):,} returns")
    axes = figure.subplots()
    low = min(float(strengths[0]), 0.0)
    high = float(strengths[-1]) + 1
    width = max(np.ceil((high - low) / MAX_INTENSITY_BINS), 1.0)
    axes.hist(strengths, bins=np.arange(low, high + width, width), weights=counts, color="C0")
    axes.axvline(float(middle) + 0.5, color="C1", label=f"median {middle:g}")
    axes.set(
        xlabel="intensity, raw value",
        ylabel="returns",
        yscale="log",
        xlim=(low, high + width),
        ylim=(0.5, None),
    )
    _draw_legend(axes)
    return figure


@_with_style
def draw_ranges(scans: Iterable[Scan], title: str) -> Any:
    """Return a figure with the number of returns at each range and time.

    Args:
        scans: at least one scan.
    """
    kept = list[tuple[int, NDArray[np.float32], bool]]()
    step = 1
    number = 0
    for number, scan in enumerate(scans, 1):
        if (number - 1) % step == 0:
            kept.append((scan.stamp_ns, scan.points.range[scan.points.valid], scan.whole))
        if len(kept) == 2 * MAX_TIME_BINS:  # limits the memory use of long inputs
            kept = kept[::2]
            step = 2 * step
    whole = [entry for entry in kept if entry[2]]
    every = whole or kept  # incomplete scans have fewer returns
    if any(len(ranges) for _, ranges, _ in every):
        farthest = np.percentile(
            np.concatenate([ranges for _, ranges, _ in every]), SHOWN_PERCENTILE
        )
    else:
        farthest = 1.0
    edges = np.linspace(0, float(farthest) * 1.05, RANGE_BINS + 1)
    times = np.array([(stamp - every[0][0]) * 1e-9 for stamp, *_ in every])
    order = np.argsort(times, kind="stable")
    if len(times) > 1:
        last = float(np.median(np.diff(times[order])))
    else:
        last = MIN_TIME_BIN_S
    counts = np.stack([np.histogram(every[which][1], edges)[0] for which in order], axis=1)
    figure = _make_figure(
        f"{title}: {number:,} scans" + f", of which one in {step} is shown" * (step > 1)
    )
    axes = figure.subplots()
    colours = import_library("matplotlib.colors", "plot").LogNorm(1, max(int(counts.max()), 2))
    begins = np.append(times[order], times[order][-1] + last)
    shown = axes.pcolormesh(
        begins,
        edges,
        np.ma.masked_equal(counts, 0),
        norm=colours,
        cmap=make_colour_map(),
        rasterized=True,
    )
    medians = [
        float(np.median(every[which][1])) if len(every[which][1]) else np.nan for which in order
    ]
    axes.plot(times[order] + last / 2, medians, color="C3", linewidth=1, label="median")
    axes.set(xlabel="time from the first scan [s]", ylabel="range [m]", ylim=(0, edges[-1]))
    _draw_legend(axes)
    figure.colorbar(shown, label=f"returns per scan, in bins of {edges[1]:.2g} m", pad=0.02)
    return figure


@_with_style
def draw_rates(rates: RateSeries, title: str) -> Any:
    """Return a figure of packets and scans per second, and of lost and invalid frames.

    Raises:
        UsageError: if the packets have no times.
    """
    seconds, (packets, lost, wrong) = rates.series()
    figure = _make_figure(
        f"{title}: {int(rates.totals[0].sum()):,} packets", 2 * PANEL_INCHES * 0.8
    )
    panels = figure.subplots(4, 1, sharex=True)
    for axes, values, label in (
        (panels[0], packets / rates.width, "packets [1/s]"),
        (panels[2], _percentage(lost, packets), "lost [%]"),
        (panels[3], _percentage(wrong, packets), "invalid [%]"),
    ):
        axes.stairs(values, seconds, baseline=None, color="C0", linewidth=1.2, clip_on=False)
        axes.set(ylabel=label, ylim=(0, max(float(np.nanmax(values, initial=0)) * 1.15, 1.0)))
    panels[1].plot(
        *zip(*rates.scans, strict=True) if rates.scans else ([], []), ".", markersize=3, color="C0"
    )
    panels[1].set(
        ylabel="scans [1/s]",
        ylim=(0, max([rate for _, rate in rates.scans if np.isfinite(rate)], default=1) * 1.3),
    )
    panels[3].set(
        xlabel=f"time from the first packet [s], in steps of {rates.width:g} s",
        xlim=(0, seconds[-1]),
    )
    figure.align_ylabels(panels)
    return figure


class RateSeries:
    """Counts packets, lost packets and invalid frames in equal steps of time.

    Args:
        live: the scans of an open device. They are read to the end, or until the time `until`.
        until: a time of `time.monotonic`.

    Attributes:
        width: the duration of a step, in seconds.
        totals: numbers of packets, lost packets and invalid frames in each step, (3, n).
        scans: (seconds since the first packet, scans per second) of each complete scan.
    """

    def __init__(self, live: LiveScans, until: float) -> None:
        self._live = live
        self._first = 0
        self._before = totals(live.device.stats)
        self.width = MIN_TIME_BIN_S
        self.totals = np.zeros((3, 1))
        self._last = 0.0
        self.scans = list[tuple[float, float]]()
        while not live.ended and time.monotonic() < until:
            live.read(0.0)
            self._count_batch()
            self.scans += [
                (self._to_seconds(scan.host_ns or scan.stamp_ns), scan.rate_hz)
                for scan in live.scans
                if scan.whole
            ]

    def _to_seconds(self, at: int) -> float:
        """Return a time in seconds since the first packet."""
        return (at - self._first) * 1e-9

    def _count_batch(self) -> None:
        """Add the newest batch of packets to the counts."""
        packets = self._live.packets
        if packets is None or not len(packets):
            return
        if packets.host_ns.any():
            times = packets.host_ns
        else:
            times = packets.time_ns
        self._first = self._first or int(times[0])
        after = totals(self._live.device.stats)
        lost, wrong = (after[name] - self._before[name] for name in ("lost", "rejected"))
        self._before = after
        steps = np.maximum((times - self._first) * (1e-9 / self.width), 0).astype(np.intp)
        self._last = max(self._last, self._to_seconds(int(times.max())))
        counted = np.bincount(steps, minlength=self.totals.shape[1]).astype(np.float64)
        grown = np.zeros((3, len(counted)))
        grown[:, : self.totals.shape[1]] = self.totals
        self.totals = grown + np.outer((1, lost / len(packets), wrong / len(packets)), counted)

    def series(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the totals of each time step.

        Consecutive steps are combined until there are at most `MAX_TIME_BINS` steps.

        Returns:
            The edges of the steps, (n + 1,) seconds, and the numbers of packets, lost packets and
            invalid frames in each step, (3, n).
        """
        if self._last < self.width:
            raise UsageError(
                f"{self._live.device.source}: the packets have no times, or all have the same time"
            )
        full = max(int(self._last / self.width), 1)
        joined = -(-full // MAX_TIME_BINS)
        counts = self.totals[:, : max(full // joined, 1) * joined]
        counts = np.add.reduceat(counts, np.arange(0, counts.shape[1], joined), axis=1)
        self.width = round(self.width * joined, 6)
        return np.arange(counts.shape[1] + 1) * self.width, counts


def make_colour_map() -> Any:
    """Return the colour map for matplotlib on a white background."""
    colours = import_library("matplotlib.colors", "plot")
    return colours.ListedColormap(
        [to_hex(rgb) for rgb in make_ramp("light", COLOUR_COUNT)], "lidarspec"
    )


def _draw_legend(axes: Any) -> None:
    """Draw the legend above the axes, so that it hides no data."""
    axes.legend(frameon=False, loc="lower right", bbox_to_anchor=(1, 0.99), borderpad=0.2)


def _percentage(part: NDArray[np.float64], rest: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `part` as a percentage of `part + rest`; nan if both are 0."""
    total = part + rest
    return np.asarray(np.divide(100 * part, total, out=np.full(len(part), np.nan), where=total > 0))


def _make_figure(title: str, height: float = PANEL_INCHES) -> Any:
    figure = import_library("matplotlib.figure", "plot").Figure(
        figsize=(WIDTH_INCHES, height), layout="constrained"
    )
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    return figure
