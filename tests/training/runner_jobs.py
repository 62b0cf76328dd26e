"""Functions that the tests of runners and studies run in other processes."""

import errno
import os
import signal
import time


def square(root, number):
    return number**2


def fail(root, words):
    raise ValueError(words)


def die_first(root, folder, times):
    """Count calls in a file, and kill the process in the first ones."""
    path = root / folder / "calls"
    path.parent.mkdir(parents=True, exist_ok=True)
    calls = int(path.read_text()) + 1 if path.exists() else 1
    path.write_text(str(calls))
    if calls <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return calls


def wait_for_interrupt(root, folder):
    """Write a file when interrupted, as a training does."""
    path = root / folder / "state"
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        path.write_text("begun")
        time.sleep(60.0)
    except KeyboardInterrupt:
        path.write_text("saved")
        raise


def surroundings(root):
    """Return what may differ between runners and must not."""
    return os.environ["OMP_NUM_THREADS"], len(os.sched_getaffinity(0))


def identity(root):
    return os.getpid()


def fill_disk(root, folder):
    """Find the disk full on the first node that is tried."""
    path = root / folder / "tried"
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        path.write_text("once")
        time.sleep(1.6)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "model")
    return "written"


def train_then_die(root, cell, steps, sets):
    """Kill the process in the middle of the first training, when the driver has a checkpoint."""
    from stable_baselines3.common.callbacks import BaseCallback

    from viapoint.training.runs.trainer import train
    from viapoint.training.study.jobs import train_and_evaluate

    class Die(BaseCallback):
        def _on_step(self):
            if self.num_timesteps >= 192:
                time.sleep(1.8)
                os.kill(os.getpid(), signal.SIGKILL)
            return True

    if not (root / cell.folder / "checkpoints").is_dir():
        train(cell.training(root), callback=Die())
    return f"{root.name}: {train_and_evaluate(root, cell, steps, sets)}"
