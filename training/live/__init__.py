"""Page in the browser on which scenes are changed by hand and the movement is planned anew."""

import importlib.util

for _name in ("viser", "mjviser"):
    if importlib.util.find_spec(_name) is None:
        raise ModuleNotFoundError(
            f"the live page needs the extra `live` (not installed: {_name}): pip install 'viapoint[live]'",
            name=_name,
        )
