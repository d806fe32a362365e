# After a SIGKILL or a power failure the next `snakemake` just continues, and beside a live one it
# waits until that is done. No rules.
#
# Snakemake leaves two things behind when it is killed: its lock, which nothing but a person would
# remove, and markers of outputs that were being written, which stop the next start. Both are
# cleared here when no other Snakemake process is alive in this folder. Liveness is an advisory file
# lock that every process holds to its end and that the kernel drops with it.
import base64
import fcntl
from pathlib import Path

from safemr.experiment.locks import ProcessLock

# What this workflow makes; what others left in the same .snakemake is theirs.
MADE = [Path(RESULTS, name) for name in ("runs", "summary", "tables", "logs", "report.html")]
MADE += [Path(FIGURES)]
IS_RECORD = re.compile(r"seed\d+-[0-9a-f]{12}").fullmatch


def marked_files(folder):
    """Snakemake's bookkeeping files in a folder and the output that each is about."""
    for path in filter(Path.is_file, Path(folder).rglob("*")):
        encoded = "".join(part.removeprefix("@") for part in path.relative_to(folder).parts)
        try:
            yield path, Path(base64.urlsafe_b64decode(encoded).decode())
        except ValueError:
            continue


def is_made(path):
    """Whether a file is one of this workflow's."""
    return any(Path(path).is_relative_to(folder) for folder in MADE)


def recover(state):
    """Clear what a killed process left; returns the descriptor that says this one is alive."""
    state.mkdir(exist_ok=True)
    alive = os.open(state / "alive", os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(alive, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        pass
    else:
        for lock in (state / "locks").glob("*.lock"):
            if all(map(is_made, lock.read_text().splitlines())):
                lock.unlink()
        for marker, output in marked_files(state / "incomplete"):
            if not is_made(output):
                continue
            # A record is complete or absent by itself; anything else may be half written.
            if not IS_RECORD(output.parent.name):
                output.unlink(missing_ok=True)
            marker.unlink()
        # A record's folder name says everything about it; what Snakemake remembers of the job
        # (its shell command, for one) must not make it train again.
        for entry, output in marked_files(state / "metadata"):
            if IS_RECORD(output.parent.name):
                entry.unlink()
    fcntl.flock(alive, fcntl.LOCK_SH)
    return alive


# One Snakemake at a time makes the files under a results root, from whatever folder it was started:
# Snakemake's own lock is looked up and written in two steps, and invites to be removed by hand.
try:
    if workflow.is_main_process and not workflow.output_settings.dryrun:
        ROOT_LOCK = ProcessLock(
            Path(RESULTS, ".work", "snakemake.lock"), f"makes the files under {RESULTS}"
        )
        ROOT_LOCK.acquire(wait=True)

    if workflow.is_main_process:
        ALIVE = recover(Path(".snakemake"))
except OSError as error:
    sys.exit(f"error: cannot write in {os.getcwd()}, which a dry run needs, too: {error}")
