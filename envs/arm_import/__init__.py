"""Import of arms from MJCF files."""

from viapoint.envs.arm_import.loader import load_arm

__all__ = ["load_arm"]
