#!/usr/bin/env bash
# Runs the nss command line (`./nss --help`), the tests (`./nss test`) or a script (`./nss python
# FILE`) in the environment that bootstrap/set_up.sh makes in .venv and .nss the first time, and again when its inputs change.
set -euo pipefail
root=$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")

# What the environment is made from: where it is, the Python asked for, and the content of files.
environment_key() {
  echo "$root ${NSS_PYTHON:-}"
  (cd "$root" && LC_ALL=C find requirements bootstrap nss_msgs setup.py setup.cfg -type f \
    -exec sha256sum {} + | LC_ALL=C sort | sha256sum)
}

environment_is_current() {
  [[ -x $root/.venv/bin/python && -x $root/.venv/bin/nss && -r $root/.nss/environment.sh &&
    -r $root/.venv/nss.key && "$(cat "$root/.nss/key" 2>/dev/null)" == "$(environment_key)" ]]
}

# Every check runs, so that one call shows all that is wrong; pytest comes last.
run_tests() {
  cd "$root"
  local failed=()
  check() {
    echo "--- $*"
    "$@" || failed+=("$*")
  }
  check ruff check .
  check ruff format --check .
  check mypy
  # As many tests at a time as there are cores, four at most. "-n 0" runs them one by one.
  check pytest -n logical --maxprocesses 4 --dist worksteal \
    --cov --cov-report=term:skip-covered "$@"
  if ((${#failed[@]})); then
    printf 'nss test: failed: %s\n' "${failed[@]}" >&2
    exit 1
  fi
}

if ! environment_is_current; then
  # shellcheck source=bootstrap/set_up.sh
  . "$root/bootstrap/set_up.sh"
  (set_up)
fi
# shellcheck source=/dev/null
. "$root/.nss/environment.sh"

if [[ ${1:-} == test ]]; then
  run_tests "${@:2}"
elif [[ ${1:-} == python ]]; then
  exec "$root/.venv/bin/python" "${@:2}"
else
  exec "$root/.venv/bin/nss" "$@"
fi
