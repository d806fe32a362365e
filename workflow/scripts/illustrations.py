"""The energy function and its safe set, a narrow passage, and the tasks."""

from pathlib import Path

from envs.drawing import draw_scene
from safemr import certify, reference
from safemr.falsification import make_simulator
from safemr.plotting import certificate, scenes, style

learned = reference.TABLE_II[reference.HEADLINE]
d_min = float(make_simulator(certify.DEFAULT_TASK, 1).d_min)
layouts = {task: make_simulator(task, 1).scene(0) for task in snakemake.params.tasks}
figures = (
    certificate.energy_and_safe_set(learned, d_min),
    certificate.narrow_passage(
        (r"handcrafted $\phi_h$", reference.PHI_H), ("learned by SafeMR (paper)", learned), d_min
    ),
    scenes.environments(layouts, draw_scene),
)
for figure, path in zip(figures, snakemake.output.pdf, strict=True):
    style.save(figure, Path(path).with_suffix(""))
