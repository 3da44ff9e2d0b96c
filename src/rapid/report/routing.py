"""The routing of the mixture: which policy decides about which vehicle."""

from collections.abc import Sequence

import numpy as np

from rapid.pages.markup import Markup, tag
from rapid.report.data import RoutingSnapshot
from rapid.report.sections import missing, section


def routing(snapshots: Sequence[RoutingSnapshot], lanes: int) -> Markup:
    """Return the signed weights of the policies for each vehicle, a column per snapshot."""
    title = "Which policy decides about which vehicle"
    if not snapshots:
        return section(
            "routing", title, missing("No routing weights were recorded; only a mixture of policies has them.")
        )
    top = max([1e-9, *(float(np.nanmax(np.abs(shot.weights_VN))) for shot in snapshots if shot.weights_VN.size)])
    count = max(shot.weights_VN.shape[1] for shot in snapshots)
    legend = [tag("span", tag("i", class_=f"swatch policy-{index % 4}"), _policy_name(index)) for index in range(count)]
    return section(
        "routing",
        title,
        tag("p", *legend, class_="legend"),
        tag("div", *(_snapshot(shot, top, lanes) for shot in snapshots), class_="columns"),
        tag(
            "p",
            "Each vehicle of the observation has a weight for each policy, which multiplies that policy's token. "
            "Weights are signed: bars to the left of the line are negative. Before adaptation the "
            "gate of the adapter is zero.",
            class_="caption",
        ),
    )


def _policy_name(index: int) -> str:
    return "policy 1, distilled" if index == 0 else f"policy {index + 1}, adapter"


def _snapshot(shot: RoutingSnapshot, top: float, lanes: int) -> Markup:
    lines: list[Markup] = []
    for vehicle, weights in enumerate(np.asarray(shot.weights_VN, np.float64)):
        where = ""
        if shot.obs_VF is not None:
            row = shot.obs_VF[vehicle]
            if row[0] < 0.5:
                continue
            lane = int(np.clip(round(float(row[2]) / 4), 0, lanes - 1)) + 1
            ahead = float(row[1] - shot.obs_VF[0, 1])
            where = f"lane {lane}" if vehicle == 0 else f"{ahead:+.0f} m, lane {lane}"
        bars = [_signed_bar(float(weight), top, index) for index, weight in enumerate(weights)]
        name = "ego" if vehicle == 0 else f"car {vehicle}"
        lines.append(tag("tr", tag("th", name, tag("small", where), scope="row"), tag("td", *bars)))
    return tag("figure", tag("figcaption", shot.label), tag("table", tag("tbody", *lines), class_="weights"))


def _signed_bar(weight: float, top: float, policy: int) -> Markup:
    width = 50 * min(abs(weight) / top, 1) if np.isfinite(weight) else 0
    left = 50 - width if weight < 0 else 50
    bar = tag("i", class_=f"policy-{policy % 4}", style=f"left:{left:.2f}%;width:{width:.2f}%")
    return tag("span", bar, tag("b", f"{weight:+.3f}"), class_="signed", title=f"{_policy_name(policy)}: {weight:+.4f}")
