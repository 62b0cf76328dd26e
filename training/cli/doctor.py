"""Command `doctor`: what works on this machine, and what to install where something does not."""

import subprocess
import sys

LIMIT = 180.0  # Time limit of a check, [s]; the first one compiles machine code
VERSIONS = "import sys, {0}; print(sys.version[:7], *(f'{{m.__name__}} {{m.__version__}}' for m in ({0})))"
ENV = "import gymnasium as g, viapoint.envs as v; e = g.make(v.ENV_IDS[1], render_mode='rgb_array'); e.reset(seed=0); "
STEP = ENV + "print(f'{e.step(0 * e.action_space.sample())[4][\"duration\"]:.3f} s of movement')"
AGENT = "from viapoint.training import load_agent; print(load_agent('viapoint/PlanarObstacles-v0').env_id)"
EXTRAS = "from viapoint.training.extras import PACKAGES, is_installed; "
EXTRAS += "print(*(n if is_installed(n) else f'(no {n}: extra {e})' for n, e in PACKAGES.items()))"
CHECKS = {  # Script that fails, or prints what it found, and remedy, by the name of what is checked
    "packages": (VERSIONS.format("numpy, gymnasium, mujoco, numba"), "pip install . in a clone"),
    "MuJoCo": (STEP, "pip install 'mujoco>=4'"),
    "agents": (AGENT, "the planner works without them"),
    "extras": (EXTRAS, ""),
    "pictures": (ENV + "print(*e.render().shape)", "on Debian: apt-get install libegl1 libgl1"),
}


def run(config: object) -> None:
    """Make all checks with the standard library alone; exit code 1 where packages or MuJoCo fail."""
    code = 0
    for name, (script, remedy) in CHECKS.items():
        works, found = outcome(script)
        verdict = "there:" if name == "extras" else "works:" if works else "fails:"
        print(f"{name:<9} {verdict} {found}{'' if works else f'; {remedy}'}")
        code |= not works and name in ("packages", "MuJoCo")
    raise SystemExit(code)


def outcome(script: str) -> tuple[bool, str]:
    """Run a script in a process, which may crash or hang; return True if it works, and its last printed line."""
    try:
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        return False, f"no answer within {LIMIT:.0f} s"
    said = (done.stderr if done.returncode else done.stdout).strip()
    return not done.returncode, (said or f"ended with code {done.returncode}").splitlines()[-1]
