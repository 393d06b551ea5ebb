"""The program ``lidarshift``."""

import os
import sys
import sysconfig

from . import _native


def main():
    """Runs the program with the arguments of this process; ends with its exit code."""
    script = os.path.join(sysconfig.get_path("scripts"), "lidarshift" + (".exe" if os.name == "nt" else ""))
    if not os.path.isfile(script):
        script = os.path.abspath(sys.argv[0])
    if not os.access(script, os.X_OK) and "study" in sys.argv[1:2]:
        sys.exit("error: a study starts the program lidarshift, which is not installed: pip install lidarshift")
    sys.exit(_native.run(["lidarshift", *sys.argv[1:]], script))


if __name__ == "__main__":
    main()
