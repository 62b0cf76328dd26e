"""What several files of tests begin with lies beside them."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent))
