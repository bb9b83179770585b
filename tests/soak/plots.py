"""Panels of lines and dots over the minutes of a soak, as SVG."""

import math
from dataclasses import dataclass, field
from html import escape

LEFT, WIDTH, HEIGHT, GAP = 70, 860, 130, 50
COLORS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#9467bd", "#8c564b")
# Lines of a long soak are drawn from this many points.
MOST_POINTS = 1500

Points = list[tuple[float, float]]


@dataclass
class Series:
    """A named line of minutes and values. Where its pieces end, the line is broken."""

    name: str
    pieces: list[Points]
    is_dots: bool = False


@dataclass
class Panel:
    """One plot: lines, and vertical marks of trouble by color."""

    title: str
    series: list[Series]
    marks: dict[str, list[float]] = field(default_factory=dict)
    is_log: bool = False
    limit: float | None = None


def figure(panels: list[Panel]) -> str:
    """All panels, one below the other, with one scale of minutes."""
    last = max((at for panel in panels for one in panel.series for piece in one.pieces for at, _ in piece), default=1.0)
    last = max(last, 0.1)
    height = len(panels) * (HEIGHT + GAP) + 40
    drawn = "".join(_panel(panel, 30 + turn * (HEIGHT + GAP), last) for turn, panel in enumerate(panels))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{LEFT + WIDTH + 30}" height="{height}" '
        f'font-family="sans-serif" font-size="11"><rect width="100%" height="100%" fill="white"/>{drawn}</svg>\n'
    )


def _panel(panel: Panel, top: float, last: float) -> str:
    values = [value for one in panel.series for piece in one.pieces for _, value in piece]
    values += [panel.limit] if panel.limit else []
    most = max(values, default=1.0) or 1.0
    least = max(min(values, default=0.1), 0.05) if panel.is_log else 0.0
    most = most * 1.3 if panel.is_log else most * 1.08

    def y(value: float) -> float:
        share = math.log(max(value, least) / least, most / least) if panel.is_log else value / most
        return top + HEIGHT * (1 - share)

    def x(at: float) -> float:
        return LEFT + WIDTH * at / last

    parts = [f'<text x="{LEFT}" y="{top - 7}" font-weight="bold">{escape(panel.title)}</text>']
    for color, times in panel.marks.items():
        path = "".join(f"M{x(at):.1f} {top}v{HEIGHT}" for at in times)
        parts.append(f'<path d="{path}" stroke="{color}" stroke-width="0.7" stroke-opacity="0.35"/>')
    parts += [_grid(y(value), f"{value:.4g}") for value in _ticks(least, most, panel.is_log)]
    if panel.limit:
        parts.append(f'<path d="M{LEFT} {y(panel.limit):.1f}h{WIDTH}" stroke="red" stroke-dasharray="4 3"/>')
    parts += [
        f'<text x="{x(at):.1f}" y="{top + HEIGHT + 13}" text-anchor="middle">{at:g} min</text>' for at in _minutes(last)
    ]
    for turn, one in enumerate(panel.series):
        color = COLORS[turn % len(COLORS)]
        at = LEFT + WIDTH - 130 * (len(panel.series) - turn)
        if len(panel.series) > 1:
            parts.append(f'<text x="{at}" y="{top - 7}" fill="{color}">{escape(one.name)}</text>')
        step = max(1, sum(map(len, one.pieces)) // MOST_POINTS)
        for piece in one.pieces:
            spots = [(x(minute), y(value)) for minute, value in _thinned(piece, step)]
            if one.is_dots:
                path = "".join(f"M{left:.1f} {up:.1f}h.01" for left, up in spots)
                parts.append(f'<path d="{path}" stroke="{color}" stroke-width="2.5" stroke-linecap="round"/>')
            else:
                path = " ".join(f"{left:.1f},{up:.1f}" for left, up in spots)
                parts.append(f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="1.2"/>')
    return "".join(parts)


def _thinned(points: Points, step: int) -> Points:
    """The highest of each `step` points."""
    return [max(points[at : at + step], key=lambda point: point[1]) for at in range(0, len(points), step)]


def _ticks(least: float, most: float, is_log: bool) -> list[float]:
    if is_log:
        return [10.0**power for power in range(math.ceil(math.log10(least)), math.floor(math.log10(most)) + 1)]
    return [most * share / 1.08 for share in (0.0, 0.5, 1.0)]


def _minutes(last: float) -> list[float]:
    step = next((one for one in (0.5, 1, 2, 5, 10, 30, 60, 120) if last / one <= 12), 240)
    return [step * turn for turn in range(int(last / step) + 1)]


def _grid(height: float, text: str) -> str:
    return (
        f'<path d="M{LEFT} {height:.1f}h{WIDTH}" stroke="#ddd"/>'
        f'<text x="{LEFT - 6}" y="{height + 4:.1f}" text-anchor="end">{text}</text>'
    )
