"""The energy function and its safe set, a narrow passage, and the tasks."""

from pathlib import Path

from envs.drawing import draw_scene, legend_of
from envs.scene import first_scene
from envs.tasks import REGISTERED_TASKS
from safemr import paper
from safemr.report.figures import certificate, scenes, style
from safemr.tasks import base_of, name_of, settings_of

learned = paper.TABLE_II[paper.HEADLINE]
d_min = REGISTERED_TASKS[paper.SENSITIVITY_TASK].d_min
pair = ((r"handcrafted $\phi_h$", paper.PHI_H), ("learned by SafeMR (paper)", learned))
layouts = {
    name_of(task): first_scene(
        REGISTERED_TASKS[base_of(task)].with_settings(**settings_of(task)), seed=0
    )
    for task in snakemake.params.tasks
}
drawn = {
    "energy_and_safe_set": lambda: certificate.energy_and_safe_set(learned, d_min),
    "narrow_passage": lambda: certificate.narrow_passage(*pair, d_min),
    "environments": lambda: scenes.environments(layouts, draw_scene, legend_of),
}
for path in map(Path, snakemake.output.pdf):
    style.save(drawn[path.stem](), path.with_suffix(""))
