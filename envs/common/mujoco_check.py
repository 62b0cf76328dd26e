"""Import of MuJoCo with an explanation if it fails."""

from __future__ import annotations

import os

try:
    import mujoco
    from mujoco import batch
except AttributeError as error:
    # MuJoCo reads an attribute of None if the OpenGL library of MUJOCO_GL is missing.
    if not os.environ.get("MUJOCO_GL"):
        raise
    raise ImportError(
        f"MUJOCO_GL={os.environ['MUJOCO_GL']} asks MuJoCo for an OpenGL library that is not installed: "
        "unset MUJOCO_GL, or install the library (Debian: apt-get install libegl1 libgl1, or libosmesa6 for osmesa)"
    ) from error
except ImportError as error:
    raise ImportError(
        f"MuJoCo 4 or newer is needed and could not be imported ({error}); where an older version was upgraded in "
        "place, repair it with: pip install --force-reinstall 'mujoco>=4'"
    ) from error

__all__ = ["batch", "mujoco"]
