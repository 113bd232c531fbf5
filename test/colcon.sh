#!/usr/bin/env bash
# Builds the package in a fresh colcon workspace, with and without --symlink-install, and uses what was installed.
# The workspace gets an environment of its own, because colcon needs an older setuptools; the libraries are .venv's.
set -euo pipefail
repository=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
python=$repository/.venv/bin/python
workspace=$(mktemp -d)
trap 'rm -rf "$workspace"' EXIT
cd "$workspace"

echo "== workspace with colcon"
"$python" -m venv .venv
libraries=$("$python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
.venv/bin/pip install -q --disable-pip-version-check colcon-common-extensions
# behind the environment's own; the repository's editable installation stays out
echo "$libraries" > "$(.venv/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/zz_libraries.pth"
mkdir -p src/dynssm_ros
git -C "$repository" ls-files -co --exclude-standard -z \
  | tar -C "$repository" --ignore-failed-read --null -cf - -T - 2> /dev/null | tar -C src/dynssm_ros -xf -
source .venv/bin/activate

use() { # use FOLDER: the commands of the sourced workspace, from elsewhere, find the configuration in FOLDER
  for command in dynssm predictor player; do
    [ -x "install/dynssm_ros/lib/dynssm_ros/$command" ] || { echo "error: no command $command" >&2; return 1; }
  done
  # colcon's scripts read unset variables
  set +u
  source install/setup.bash
  set -u
  cd /
  "$workspace/install/dynssm_ros/lib/dynssm_ros/dynssm" --version
  root=$(python -c 'from dynssm_ros.configuration import config_root; print(config_root())')
  [ "$root" = "$workspace/$1" ] || { echo "error: configuration in $root, expected $workspace/$1" >&2; return 1; }
  python -c '
from dynssm_ros.vehicle.parameters import load_vehicle
from ament_index_python.packages import get_package_share_directory as share
from pathlib import Path
load_vehicle("orca")
assert (Path(share("dynssm_ros")) / "launch" / "predictor.launch.py").is_file()
assert (Path(share("dynssm_ros")) / "config" / "predictor.yaml").is_file()'
  # the wheels' ROS 2 is known to the repository's interpreter only
  said=$("$python" "$workspace/install/dynssm_ros/lib/dynssm_ros/predictor" 2>&1) && return 1
  [[ $said == *"parameter model"* ]] || { echo "error: the predictor said: $said" >&2; return 1; }
}

echo "== colcon build"
colcon build --event-handlers console_direct- console_cohesion-
(use install/dynssm_ros/share/dynssm_ros/config)
rm -rf build install log
echo "== colcon build --symlink-install"
colcon build --symlink-install --event-handlers console_direct- console_cohesion-
(use src/dynssm_ros/config)
echo "== colcon builds the package, and it finds its files"
