"""Makes the repository's root importable as `material_palette`, whatever the clone's folder is called."""

import importlib.util
import os
import sys
from pathlib import Path

# threads within torch's operations wait on each other as soon as another program runs; before torch is imported
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent

spec = importlib.util.spec_from_file_location("dev", ROOT / "dev.py")
sys.modules["dev"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(sys.modules["dev"])
sys.modules["dev"].load_package()
