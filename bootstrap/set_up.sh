# Sourced by ./nss: makes or mends the environment. No root, and nothing outside .venv and .nss
# but pip's cache. Each part has a stamp that is written when the part is complete, so that an
# interrupted set-up goes on, or starts that part again, at the next call.
# shellcheck shell=bash disable=SC2154 # root is set by ./nss

venv=$root/.venv
state=$root/.nss
system=$state/system # libraries and headers of the distribution that this machine lacks
log=$state/setup.log
disk_space_mb=5200 # .venv takes 3.5 GB, the downloads and the copy that pip keeps of them 1.7 GB

say() { printf 'nss: [%3d s] %s\n' "$SECONDS" "$1" >&2; }

fail() {
  printf 'nss: %s\n' "$1" >&2
  [[ ! -s $log ]] || printf 'nss: the full log of this set-up is %s\n' "$log" >&2
  exit 1
}

# logged WHAT COMMAND...: runs a command into the log; stops with one sentence when it fails.
logged() {
  quietly "${@:2}" || {
    disk_is_full && fail "the disk is full: free some space in $root or ${TMPDIR:-/tmp} and call again."
    fail "$1 failed."
  }
}

# Children share the lock, so that one that outlives us is waited for by the next call.
quietly() {
  echo "+ $*" >>"$log"
  "$@" >>"$log" 2>&1 </dev/null
}

free_mb() { df --output=avail -BM "$1" | tail -n 1 | tr -dc 0-9; }

disk_is_full() {
  grep -qE 'No space left on device|Disk quota exceeded' "$log" ||
    (($(free_mb "$state") < 20 || $(free_mb "${TMPDIR:-/tmp}") < 20))
}

set_up() {
  set -E
  trap 'fail "the set-up stopped unexpectedly (${BASH_SOURCE[0]##*/}, line $LINENO)."' ERR
  trap 'fail "the set-up was interrupted; the next call takes it up again."' INT TERM HUP
  SECONDS=0
  cd "$root"
  { mkdir -p "$state" && exec 9>"$state/lock"; } 2>/dev/null || fail "cannot write in $root."
  if ! flock --nonblock 9; then
    say "waiting for another set-up of $root"
    flock 9
    ! environment_is_current || return 0
  fi
  local key
  key=$(environment_key)
  rm -f "$state/key"
  : >"$log"

  check_machine
  local python
  choose_python
  make_venv
  install_requirements
  write_environment
  # shellcheck source=/dev/null
  . "$state/environment.sh"
  provide_libraries
  build_messages
  logged "installing nss_ros into $venv" \
    "$venv/bin/python" -m pip install --no-deps --no-build-isolation --editable "$root"
  check_environment

  rm -rf "$state/downloads" "$state/apt" "$state/apt_cache"
  printf '%s\n' "$key" >"$state/key"
  say "ready"
}

check_machine() {
  [[ $(uname -sm) == "Linux x86_64" ]] ||
    fail "nss needs Linux on x86_64 (the ROS 2 and Open3D wheels exist for no other); this is $(uname -sm)."
  local source=$state/compiler_check
  printf '#include <stdlib.h>\nint main(void) { return 0; }\n' >"$source.c"
  printf '#include <string>\nint main() { return static_cast<int>(std::string().size()); }\n' >"$source.cpp"
  compiles "$source.c" "${CC:-}" cc gcc clang ||
    fail "nss needs a C compiler: install one, for example with \`sudo apt-get install build-essential\`."
  compiles "$source.cpp" "${CXX:-}" c++ g++ clang++ ||
    fail "nss needs a C++ compiler: install one, for example with \`sudo apt-get install build-essential\`."
  rm -f "$source"*
}

# compiles SOURCE COMPILER...: whether the first of the compilers that exists makes a program of it.
compiles() {
  local compiler
  for compiler in "${@:2}"; do
    if [[ $compiler ]] && command -v "$compiler" >/dev/null; then
      quietly "$compiler" -o "$1.out" "$1"
      return
    fi
  done
  return 1
}

# Sets python to the interpreter under any virtual environment or shim, by its versioned name: a
# distribution upgrade then removes it rather than changing it under .venv.
choose_python() {
  local candidate question='import os, sys
sys.exit(1) if sys.version_info[:2] not in ((3, 11), (3, 12)) else None
print(os.path.realpath(getattr(sys, "_base_executable", sys.executable)))'
  if [[ ${NSS_PYTHON:-} ]]; then
    python=$("$NSS_PYTHON" -c "$question" 2>/dev/null) ||
      fail "NSS_PYTHON is '$NSS_PYTHON', which is not a working Python 3.11 or 3.12."
    return
  fi
  if [[ -r $venv/nss.key ]] && python=$("$venv/bin/python" -c "$question" 2>/dev/null); then
    return
  fi
  for candidate in python3 python3.12 python3.11; do
    ! python=$("$candidate" -c "$question" 2>/dev/null) || return 0
  done
  fail "nss needs Python 3.11 or 3.12 and found $(python3 --version 2>/dev/null || echo 'no python3'): install one of them, or name it in NSS_PYTHON."
}

make_venv() {
  if [[ -r $venv/nss.key && "$(cat "$venv/nss.python" 2>/dev/null)" == "$python" ]] &&
    "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
    return
  fi
  [[ ! -e $venv || -e $venv/nss.python ]] ||
    fail "$venv exists and was not made by nss: move it away and call again."
  rm -rf "$venv"
  (($(free_mb "$root") >= disk_space_mb)) ||
    fail "too little disk space: nss needs $disk_space_mb MB in $root, where $(free_mb "$root") MB are free."
  say "making .venv with $("$python" --version) ($python)"
  mkdir "$venv"
  printf '%s\n' "$python" >"$venv/nss.python"
  if "$python" -c 'import venv, ensurepip' 2>/dev/null; then
    logged "making $venv" "$python" -m venv "$venv"
  else
    make_venv_without_ensurepip
  fi
}

# Debian and Ubuntu keep ensurepip in python3-venv, which a fresh machine lacks.
make_venv_without_ensurepip() {
  local wheel mend
  mend="nss needs the venv module of $python: install it, for example with \`sudo apt-get install ${python##*/}-venv\`."
  quietly "$python" -m venv --without-pip "$venv" || fail "$mend"
  fetch_packages python3-pip-whl || fail "$mend"
  wheel=$(echo "$system"/usr/share/python-wheels/pip-*.whl)
  quietly "$venv/bin/python" "$wheel/pip" install --no-index "$wheel" || fail "$mend"
}

# Unpacks packages of the distribution into .nss/system, with package lists of our own when the
# machine's are missing or old.
fetch_packages() {
  command -v apt-get >/dev/null && command -v dpkg-deb >/dev/null || return 1
  local downloads=$state/downloads lists=$state/apt package
  local -a own_lists=(-o "Dir::State::lists=$lists" -o "Dir::Cache=$state/apt_cache")
  rm -rf "$downloads"
  mkdir -p "$downloads" "$lists/partial" "$state/apt_cache/archives/partial" "$system"
  (
    cd "$downloads"
    quietly apt-get download "$@" ||
      { quietly apt-get "${own_lists[@]}" update && quietly apt-get "${own_lists[@]}" download "$@"; }
  ) || return 1
  for package in "$downloads"/*.deb; do
    quietly dpkg-deb --extract "$package" "$system" || return 1
  done
}

install_requirements() {
  local key
  key=$(sha256sum requirements/*.txt | sha256sum)
  if [[ "$(cat "$venv/nss.key" 2>/dev/null)" != "$key" ]]; then
    say "installing the pinned packages (0.9 GB to download)"
    rm -f "$venv/nss.key" "$state/install/nss.key"
    install_torch
    PIP_USER=0 quietly "$venv/bin/python" -m pip install --disable-pip-version-check --no-input \
      --retries 3 --requirement requirements/requirements.txt \
      --constraint requirements/constraints.txt || explain_pip
    repair_wheels
    printf '%s\n' "$key" >"$venv/nss.key"
  fi
}

# PyPI's torch for Linux is a CUDA build of several GB; its makers' own index has one for the CPU.
# Where that index cannot be reached, the other one is installed with the rest, and works too.
install_torch() {
  PIP_USER=0 PIP_EXTRA_INDEX_URL='' quietly "$venv/bin/python" -m pip install \
    --disable-pip-version-check --no-input --no-deps --retries 0 --timeout 15 \
    --index-url https://download.pytorch.org/whl/cpu torch --constraint requirements/constraints.txt ||
    say "no CPU build of torch can be fetched from download.pytorch.org: taking PyPI's, which is larger"
}

explain_pip() {
  ! disk_is_full ||
    fail "the disk is full: free some space in $root or ${TMPDIR:-/tmp} and call again."
  ! grep -qE 'NewConnectionError|ConnectTimeout|NameResolutionError|ProxyError|ReadTimeout|SSLError' "$log" ||
    fail "no Python package index can be reached: check the network, or pip's settings, and call again."
  fail "installing the pinned packages failed."
}

# The ROS wheels name the include folders of the machine that built them, and Open3D's links to a
# libusb that it does not bring.
repair_wheels() {
  local numpy_include site_packages
  numpy_include=$("$venv/bin/python" -c 'import numpy; print(numpy.get_include())')
  find "$venv/share" -name '*.cmake' -exec sed -i -E \
    -e "s|/opt/python/[^;\"]*/numpy/_core/include|$numpy_include|g" \
    -e "s|/opt/python/[^;\"]*/include/python3\.[0-9]+|$venv/include/headers|g" {} +
  site_packages=$(echo "$venv"/lib/python3.*/site-packages)
  ln -sfn ../libusb_package/libusb-1.0.so "$site_packages/open3d/libusb-1.0.so.0"
}

write_environment() {
  local site_packages library_path
  site_packages=$(cd "$venv" && echo lib/python3.*/site-packages)
  library_path=$state/install/lib:$(printf '%s:' "$venv/lib" "$venv/$site_packages"/ros_*.libs)
  library_path+=$system/usr/lib/x86_64-linux-gnu:$system/lib/x86_64-linux-gnu
  cat >"$state/environment.sh" <<EOF
# Written by bootstrap/set_up.sh; source it to work with $venv by hand.
# A ROS installation that the caller has sourced would mix with the one in .venv.
[[ -z \${AMENT_PREFIX_PATH:-} ]] || unset PYTHONPATH LD_LIBRARY_PATH
unset PYTHONHOME CMAKE_PREFIX_PATH COLCON_PREFIX_PATH
export VIRTUAL_ENV=$(quoted "$venv")
export PATH=$(quoted "$venv/bin"):\$PATH
export AMENT_PREFIX_PATH=$(quoted "$state/install:$venv")
export PYTHONPATH=$(quoted "$state/install/$site_packages")\${PYTHONPATH:+:\$PYTHONPATH}
export LD_LIBRARY_PATH=$(quoted "$library_path")\${LD_LIBRARY_PATH:+:\$LD_LIBRARY_PATH}
export ROS_DISTRO=jazzy ROS_VERSION=2 ROS_PYTHON_VERSION=3 RMW_IMPLEMENTATION=rmw_fastrtps_cpp
export ROS_AUTOMATIC_DISCOVERY_RANGE=\${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}
# The ROS wheels start Python twice to set LD_LIBRARY_PATH; it is set.
export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1
EOF
}

quoted() { printf '%q' "$1"; }

# Open3D links to libraries of a desktop that servers and containers lack, and these to others:
# fetch what is missing until nothing is.
provide_libraries() {
  local missing
  for _ in 1 2 3 4 5; do
    missing=$(missing_libraries)
    [[ $missing ]] || return 0
    say "fetching system libraries that Open3D needs: ${missing//$'\n'/ }"
    # shellcheck disable=SC2046 # one word for each package
    fetch_packages $(package_of <<<"$missing") || break
  done
  fail "Open3D needs system libraries that are missing (${missing//$'\n'/ }): install them with \`sudo apt-get install libegl1 libgl1 libx11-6 libidn2-0 libudev1\`."
}

missing_libraries() {
  {
    ldd "$venv"/lib/python3.*/site-packages/open3d/{libOpen3D,pybind}*.so*
    find "$system" -name '*.so.*' -exec ldd {} + || true
  } 2>/dev/null | sed -nE 's/^\s*(\S+) => not found.*/\1/p' | sort -u
}

# Debian names a library's package after it: libfoo.so.1 is in libfoo1, libfoo2.so.1 in libfoo2-1.
package_of() {
  tr '[:upper:]' '[:lower:]' |
    sed -E -e 's/^libgldispatch\.so\.0$/libglvnd0/' -e 's/([0-9])\.so\./\1-/' -e 's/\.so\.//'
}

# Links .venv/include/headers to the folder of Python.h, fetched when this machine lacks it.
provide_headers() {
  local include
  include=$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("include"))')
  if [[ ! -e $include/Python.h ]]; then
    say "fetching the headers of ${include##*/}"
    fetch_packages "lib${include##*/}-dev" && [[ -e $system/usr/include/${include##*/}/Python.h ]] ||
      fail "nss needs the headers of $python: install them, for example with \`sudo apt-get install ${include##*/}-dev\`."
    include=$system/usr/include/${include##*/}
  fi
  ln -sfn "$include" "$venv/include/headers"
}

build_messages() {
  local key
  key=$(find nss_msgs bootstrap/tf2_msgs -type f -exec sha256sum {} + | LC_ALL=C sort | sha256sum)
  [[ "$(cat "$state/install/nss.key" 2>/dev/null)" != "$key" ]] || return 0
  provide_headers
  say "building the ROS messages (nss_msgs, tf2_msgs)"
  rm -rf "$state/build" "$state/install"
  # From .nss, so that neither colcon_defaults.yaml nor the user's own defaults apply.
  (
    cd "$state"
    export COLCON_HOME=$state/colcon CPATH=$system/usr/include${CPATH:+:$CPATH}
    logged "building the ROS messages" \
      "$venv/bin/colcon" --log-base log build --merge-install \
      --base-paths ../nss_msgs ../bootstrap/tf2_msgs --cmake-args -G Ninja \
      -D BUILD_TESTING=OFF -D "Python3_EXECUTABLE=$venv/bin/python" \
      -D "Python3_INCLUDE_DIR=$venv/include/headers"
  )
  rm -rf "$state/build"
  printf '%s\n' "$key" >"$state/install/nss.key"
}

check_environment() {
  logged "importing what was installed" "$venv/bin/python" -c '
import nss_msgs.msg, open3d, rclpy.serialization, tf2_msgs.msg
for message in (nss_msgs.msg.FragmentPair(), tf2_msgs.msg.TFMessage()):
    rclpy.serialization.serialize_message(message)
'
}
