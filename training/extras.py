"""Message of a failed import: what to install."""

# Extras of packages that a command imports when it needs them; others belong to `training`
EXTRAS = {"minari": "minari", "mjviser": "live", "optuna": "study", "ray": "study", "viser": "live"}


def explain_import_error(error: ImportError, subject: str = "the command") -> str:
    """Return one line on a failed import of `subject`: what to install if a package is missing."""
    missing = (error.name or "").partition(".")[0]
    if isinstance(error, ModuleNotFoundError) and missing not in ("", "viapoint"):
        extra = EXTRAS.get(missing, "training")
        return (
            f"{subject} needs the extra `{extra}` (not installed: {missing}): pip install 'viapoint[{extra}]'"
        )
    return f"{type(error).__name__}: {' '.join(str(error).split())} (viapoint doctor says more)"
