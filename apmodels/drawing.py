"""The Bayes net of one time slice, as an SVG drawing.

Time runs to the right and causes run down: at the left the step before and the actions, in the middle the states
and the observations, at the right what is drawn once. Grey is observed or known, white is hidden, a square is
chosen, a double rim is deterministic, and the interest has a coloured rim.
"""

from __future__ import annotations

import html
import math
from typing import Any

ROLES = ("static", "action", "state", "observation")
ACROSS, DOWN, RADIUS, ZIGZAG = 150, 100, 30, 80
INTEREST = "#d6336c"
COLOURS = {
    "given": "#868e96",
    "finite": "#1c7ed6",
    "selects": "#7048e8",
    "affine": "#2f9e44",
    "moves": "#099268",
    "nonlinear": "#e8590c",
}

Place = tuple[float, float]


def draw(model: Any) -> str:
    """Return an SVG element that shows a model's variables, and its arrows by kind."""
    structure = model.structure
    places = _places(structure)
    width = max(x for x, _ in places.values()) + RADIUS + 30
    height = max(y for _, y in places.values()) + RADIUS + 60
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" '
        f'viewBox="0 0 {width:.0f} {height:.0f}" font-family="sans-serif" font-size="12" style="background:#ffffff">',
        f"<title>{html.escape(structure.model)}</title>",
        _markers(),
    ]
    for arrow in structure.arrows:
        parts.append(_arrow(places[arrow.parent, arrow.lag], places[arrow.child, 0], arrow.kind, arrow.why))
    for (name, lag), place in places.items():
        parts.append(_node(structure, name, lag, place))
    parts.append(_legend({arrow.kind for arrow in structure.arrows}, height))
    return "\n".join([*parts, "</svg>"])


def _places(structure: Any) -> dict[tuple[str, int], Place]:
    """Where each variable stands.

    At the left what was a step ago and what is chosen, in the middle the states and below them what is observed,
    at the right what is drawn once; states stand in zigzag, so that arrows do not run through nodes.
    """
    places: dict[tuple[str, int], Place] = {}
    lagged = {arrow.parent for arrow in structure.arrows if arrow.lag}
    named = {role: [n.name for n in structure.nodes.values() if n.role == role] for role in ROLES}
    left, top = RADIUS + 30.0, RADIUS + 20.0
    middle = left + (ACROSS if lagged or named["action"] else 0)
    for i, name in enumerate(named["action"]):
        places[name, 0] = (left, top + i * DOWN)
        if name in lagged:
            places[name, 1] = (left + ACROSS * 0.6, top + i * DOWN)
    y = top + DOWN * len(named["action"])
    for i, name in enumerate(named["state"]):
        places[name, 0] = (middle + ZIGZAG * (i % 2), y)
        if name in lagged:
            places[name, 1] = (left, y)
        y += DOWN
    y = max(y, top + DOWN * len(named["static"]) * 0.5)
    for i, name in enumerate(named["observation"]):
        places[name, 0] = (middle + i * ACROSS, y)
        if name in lagged:
            places[name, 1] = (left, y)
    right = middle + ACROSS * max(1, len(named["observation"])) + (ZIGZAG if len(named["state"]) > 1 else 0)
    for i, name in enumerate(named["static"]):
        places[name, 0] = (right, top + i * DOWN)
    return places


def _node(structure: Any, name: str, lag: int, place: Place) -> str:
    node = structure.nodes[name]
    fill = "#ffffff" if node.hidden else "#dee2e6"
    rim = INTEREST if name in structure.interest and not lag else "#343a40"
    style = f'fill="{fill}" stroke="{rim}" stroke-width="{2.5 if rim == INTEREST else 1.4}"'
    x, y = place
    dash = ' stroke-dasharray="4 3"' if lag else ""
    if node.role == "action":
        shape = f'<rect x="{x - RADIUS}" y="{y - 22}" width="{2 * RADIUS}" height="44" {style}{dash}/>'
    else:
        shape = f'<circle cx="{x}" cy="{y}" r="{RADIUS}" {style}{dash}/>'
        if not node.random:
            shape += f'<circle cx="{x}" cy="{y}" r="{RADIUS - 4}" fill="none" stroke="{rim}" stroke-width="1"/>'
    label = html.escape(name)
    size = min(12.0, 2 * (RADIUS - 3) / max(len(name), 1) * 1.6)
    under = "a step ago" if lag else node.plan
    return (
        f"<g><title>{html.escape(f'{name}: {node.family}, {node.plan}, {node.why}')}</title>{shape}"
        f'<text x="{x}" y="{y + 4}" text-anchor="middle" font-size="{size:.1f}">{label}</text>'
        f'<text x="{x}" y="{y + RADIUS + 12}" text-anchor="middle" font-size="9" fill="#868e96">{under}</text></g>'
    )


def _arrow(start: Place, end: Place, kind: str, why: str) -> str:
    (x0, y0), (x1, y1) = start, end
    length = math.hypot(x1 - x0, y1 - y0) or 1.0
    ux, uy = (x1 - x0) / length, (y1 - y0) / length
    x0, y0 = x0 + ux * (RADIUS + 1), y0 + uy * (RADIUS + 1)
    x1, y1 = x1 - ux * (RADIUS + 5), y1 - uy * (RADIUS + 5)
    # A slight bend keeps arrows between the same rows apart.
    bend = 0.12 * length
    cx, cy = (x0 + x1) / 2 - uy * bend, (y0 + y1) / 2 + ux * bend
    return (
        f"<g><title>{html.escape(f'{kind}: {why}')}</title>"
        f'<path d="M{x0:.1f},{y0:.1f} Q{cx:.1f},{cy:.1f} {x1:.1f},{y1:.1f}" fill="none" '
        f'stroke="{COLOURS[kind]}" stroke-width="1.6" marker-end="url(#apm-{kind})"/></g>'
    )


def _markers() -> str:
    heads = [
        f'<marker id="apm-{kind}" viewBox="0 0 10 10" refX="7" refY="5" markerWidth="7" markerHeight="7" '
        f'orient="auto"><path d="M0,0 L10,5 L0,10 z" fill="{colour}"/></marker>'
        for kind, colour in COLOURS.items()
    ]
    return f"<defs>{''.join(heads)}</defs>"


def _legend(kinds: set[str], height: float) -> str:
    parts = []
    for i, kind in enumerate(kind for kind in COLOURS if kind in kinds):
        x = 12 + i * 78
        parts.append(f'<line x1="{x}" x2="{x + 18}" y1="{height - 12}" y2="{height - 12}" stroke="{COLOURS[kind]}"/>')
        parts.append(f'<text x="{x + 22}" y="{height - 8}" font-size="10">{kind}</text>')
    return "".join(parts)
