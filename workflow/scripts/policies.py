"""Multiplier maps, trajectories, an animation, and which policies are not recorded."""

from pathlib import Path

import pandas as pd

from envs.drawing import draw_scene, legend_of
from safemr import files
from safemr.measure import tracks
from safemr.report.figures import certificate, scenes, style

params, output = snakemake.params, snakemake.output
stored = {
    task: files.load_arrays(path) for task, path in zip(params.tasks, snakemake.input, strict=True)
}


def recorded(task, part):
    """Variant -> arrays of one part, for the variants whose policy was recorded."""
    found = {
        variant: tracks.below(stored[task], f"{variant}/{part}/") for variant in params.variants
    }
    return {variant: arrays for variant, arrays in found.items() if arrays}


episodes = {task: recorded(task, "episodes") for task in params.tasks}
maps = {task: recorded(task, "map") for task in params.tasks}
method = params.method if params.method in params.variants else params.variants[0]
figures = [
    certificate.multiplier_maps(
        {task: found[method] for task, found in maps.items() if method in found}, params.tasks
    )
]
figures += [
    scenes.trajectories(episodes[task], draw_scene, steps=params.steps, entries=legend_of)
    for task in params.tasks
]
for figure, path in zip(figures, output.pdf, strict=True):
    style.save(figure, Path(path).with_suffix(""))
best = max(params.tasks, key=lambda task: len(episodes[task]))
scenes.animation(episodes[best], draw_scene, output.animation)
absent = [(t, v) for t in params.tasks for v in params.variants if v not in episodes[t]]
for task, variant in absent:
    print(f"not drawn, no policy recorded: {variant} on {task}")
pd.DataFrame(absent, columns=["task", "variant"]).to_csv(output.missing, index=False)
