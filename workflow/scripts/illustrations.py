"""The energy function and its safe set, a narrow passage, and the tasks."""

from pathlib import Path

from envs.drawing import draw_scene
from safemr import paper
from safemr.certificates.falsification import make_simulator
from safemr.measure import certify
from safemr.report.figures import certificate, scenes, style
from safemr.tasks import name_of

learned = paper.TABLE_II[paper.HEADLINE]
d_min = float(make_simulator(certify.DEFAULT_TASK, 1).d_min)
pair = ((r"handcrafted $\phi_h$", paper.PHI_H), ("learned by SafeMR (paper)", learned))
layouts = {name_of(task): make_simulator(task, 1).scene(0) for task in snakemake.params.tasks}
drawn = {
    "energy_and_safe_set": lambda: certificate.energy_and_safe_set(learned, d_min),
    "narrow_passage": lambda: certificate.narrow_passage(*pair, d_min),
    "environments": lambda: scenes.environments(layouts, draw_scene),
}
for path in map(Path, snakemake.output.pdf):
    style.save(drawn[path.stem](), path.with_suffix(""))
