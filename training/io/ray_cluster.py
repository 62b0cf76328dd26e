"""Connection to a Ray cluster."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from viapoint.training.io.installed import installed

SILENCE = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_TQDM_PATCH_PRINT": "0"}
"""Environment variables of Ray: it sends nothing to its authors."""
LOOPBACK = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
"""Environment variable that keeps Ray on 127.0.0.1. Ray reads it when it is imported; without it, Ray replaces
127.0.0.1 by another address of the machine, and waits there in vain for a cluster that listens on 127.0.0.1 alone."""


def import_ray() -> Any:
    """Import Ray, which is not imported before it is used.

    Raises:
        ImportError: It is not installed.
    """
    for name, value in SILENCE.items():
        os.environ.setdefault(name, value)
    try:
        import ray
    except ImportError:
        raise ImportError("Ray is not installed: pip install 'viapoint[cluster]'", name="ray") from None
    return ray


def _has_token() -> bool:
    """Return whether this machine has a token for clusters, in one of the places where Ray looks for it."""
    path = os.environ.get("RAY_AUTH_TOKEN_PATH") or Path.home() / ".ray" / "auth_token"
    return bool(os.environ.get("RAY_AUTH_TOKEN")) or Path(path).is_file()


def connect(address: str | None = None, cpus: int | None = None) -> bool:
    """Connect this process to a cluster, unless it is connected. Import Ray afterwards, as it reads settings then.

    Args:
        address: `ray://HOST:PORT`; None for the cluster of the environment variable RAY_ADDRESS, or without it for a
            Ray of its own on this machine, which listens on 127.0.0.1 and ends with the process.
        cpus: Number of cores that a Ray of its own may use; all by default.

    Returns:
        True if this call connected, so that the caller disconnects.

    Raises:
        ValueError: There is no cluster at this address.
    """
    if address is None and "ray" in sys.modules and import_ray().is_initialized():
        return False
    address = address or os.environ.get("RAY_ADDRESS")
    settings: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address is None or address.startswith(("127.0.0.1:", "localhost:")):
        for name, value in LOOPBACK.items():
            os.environ.setdefault(name, value)
    if address is None:
        settings |= {"num_cpus": cpus, "include_dashboard": False, "_node_ip_address": "127.0.0.1"}
    try:
        if address is not None:
            _check_listens(address)
            if _has_token():  # a driver sends it only in this mode, which Ray reads when it is imported
                os.environ.setdefault("RAY_AUTH_MODE", "token")
        import_ray().init(address=address or "local", **settings)
    except ImportError:
        raise
    except Exception as error:  # Ray has no common class for what may go wrong here
        where = "on this machine" if address is None else f"at {address}"
        text = " ".join(str(error).split())
        raise ValueError(
            f"no Ray cluster can be used {where} ({text}); start one with: ray start --head"
        ) from error
    return True


def _check_listens(address: str) -> None:
    """Check that something listens at an address, as Ray itself tries for minutes."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if address in ("auto", "local"):
        return
    if not colon or not port.isdigit():
        raise ValueError("it must be HOST:PORT")
    socket.create_connection((host, int(port)), timeout=10.0).close()


def check_nodes(options: Mapping[str, Any] | None = None) -> None:
    """Check that every node has the packages of this machine."""
    ray = import_ray()
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    there = ray.remote(num_cpus=0, max_retries=0, **(options or {}))(installed)
    nodes = [node for node in ray.nodes() if node["Alive"]]
    asked = [
        there.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)).remote()
        for node in nodes
    ]
    for node, reference in zip(nodes, asked, strict=True):
        name = f"{node['NodeManagerHostname']}/{node['NodeID'][:6]}"
        try:
            found = ray.get(reference)
        except Exception as error:  # such as of a node that lacks a package
            reason = " ".join(str(error).split())[-300:]
            raise ValueError(f"node {name} cannot run viapoint: {reason}") from error
        check_versions(found, installed(), name)


def check_versions(found: dict[str, str], wanted: dict[str, str], node: str) -> None:
    """Check that the packages of a node are those of the driver."""
    others = [
        f"{name} {found.get(name)}, not {wanted[name]}" for name in wanted if found.get(name) != wanted[name]
    ]
    if others:
        raise ValueError(f"node {node} has {'; '.join(others)}: install the same versions on all nodes")
