"""A run with every part, made up; all text in it may be hostile."""

import numpy as np

from rapid.config_io import to_dict
from rapid.evaluation.metrics import EpisodeRow
from rapid.evaluation.recording import Recording
from rapid.presets import preset
from rapid.report import ReportData, RoutingSnapshot

SCENARIO = "lane-3-density-2"
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)> \u2028\u2029 & \"'`{{payload}} \ud800 <!--"


def rows(agent: str, attack: str = "none", seeds: int = 8, **changes) -> list[EpisodeRow]:
    return [
        EpisodeRow(
            scenario=SCENARIO,
            agent=agent,
            seed=seed,
            attack=attack,
            episode_return=15.0 + seed,
            length=30,
            crashed=seed == 0,
            mean_speed=20.0,
            distance=600.0,
            lane_changes=2,
            min_ttc=3.0,
            shares=(0.1, 0.5, 0.1, 0.2, 0.1),
            **changes,
        )
        for seed in range(seeds)
    ]


def recording(said: str = "the lane is free", q: bool = True) -> Recording:
    obs = np.zeros((4, 15, 5), np.float32)
    for t in range(4):
        obs[t, 0] = (1, 100 + 20 * t, 4, 20, 0)
        obs[t, 1] = (1, 130 + 15 * t, 0, 15, 0)
    values = np.array([[1, 2, 3, np.nan, 5]] * 3, np.float32) if q else None
    return Recording(
        "teacher",
        SCENARIO,
        900_000,
        "none",
        obs,
        np.array([0, 3, 4]),
        np.array([0.5, 0.6, np.nan]),
        True,
        values,
        answered=(said,) * 3,
    )


def full(hostile: str = "plain") -> ReportData:
    distill = [{"iteration": i, "td": 1 / i, "robust": 1.6 / i, "evaluation": {"return": i}} for i in range(1, 30)]
    adapt = [{"step": i, "gate": i / 100, "agreement": None, "evaluation": {"return": i}} for i in range(1, 30)]
    return ReportData(
        title=hostile,
        settings=to_dict(preset()) | {"note": hostile},
        versions={"torch": "2", hostile: hostile},
        commit=hostile,
        command=hostile,
        timings={"collect": 10.0, hostile: 5.0},
        rows=[
            *rows("slower", kind="floor"),
            *rows(hostile, kind="teacher", seeds=1),
            *rows("RAPID", training_seed=0, has_network=True, origin="rapid"),
            *rows("RAPID", "pgd", training_seed=0, has_network=True, gradient_attack=True),
            *rows("RAPID", hostile, training_seed=0, has_network=True),
        ],
        distill={"distilled": distill, hostile: distill},
        adapt={"RAPID": adapt},
        routing=[RoutingSnapshot(hostile, np.tile([0.7, -0.2], (15, 1)).astype(np.float32), recording().obs_TVF[0])],
        recordings=[recording(hostile), recording(q=False)],
        dataset={"transitions": 4000, hostile: {"p": 0.25, "answer": hostile}},
        notes=[hostile],
    )
