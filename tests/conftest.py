"""Settings for tests that start Ray, and the order of the files."""

import os

# Ray reads this once, when it is imported; otherwise it replaces 127.0.0.1 by another address.
os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"


def pytest_collection_modifyitems(items):
    """Run the longest files first, so that no worker waits for one at the end."""
    items.sort(key=lambda item: item.path.name not in ("test_study.py", "test_live_page.py"))
