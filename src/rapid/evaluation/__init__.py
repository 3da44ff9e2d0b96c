"""Measuring an agent: rollouts over fixed spawns, driving metrics, statistics, the summary table.

`rollouts.run_episodes` drives, `metrics.EpisodeRow` is what is kept of an episode, `statistics.estimate` makes numbers
with intervals of rows, `summary.summarize` the table.
"""
