#!/bin/sh
# Install system packages that are missing, if we may; otherwise say which.
# Usage: system_packages.sh gl PYTHON     what MuJoCo's renderer draws with, without a screen
#        system_packages.sh display       what the tests of windows need
#        system_packages.sh arm           what the tests of other processors need
#        system_packages.sh orbslam3 PYTHON  what ORB-SLAM3 is linked with
#        system_packages.sh peers         what the benchmarks compare with
set -u

has_what_it_takes() {
    case "$1" in
    gl) "$2" -c 'from sims.cameras.opengl import open_context; open_context(8, 8, 1).free()' ;;
    orbslam3) "$2" -c "import pyorbslam3" ;;
    arm) command -v aarch64-linux-gnu-g++ && command -v qemu-aarch64 ;;
    display) command -v Xvfb && command -v xdotool ;;
    peers) command -v g++ && dpkg -s libroscpp-dev libnodeletlib-dev python3-rosmaster python3-rospy ;;
    esac >/dev/null 2>&1
}

case "$1" in
gl) packages="libegl1 libgl1 libgl1-mesa-dri" without="renderer = mujoco and the tests of it do not draw" ;;
display) packages="xvfb xdotool" without="tests of windows are skipped" ;;
arm) packages="g++-aarch64-linux-gnu qemu-user" without="tests of other processors are skipped" ;;
orbslam3)
    packages="libgl1 libegl1 libopengl0 libsm6 libice6 libx11-6 libxext6"
    without="ORB-SLAM3 cannot be loaded"
    ;;
peers)
    packages="g++ libroscpp-dev libnodeletlib-dev python3-rosmaster python3-rospy python3-numpy"
    without="the C++ and ROS 1 peers are not measured"
    ;;
esac

has_what_it_takes "$@" && exit 0
if command -v apt-get >/dev/null && [ "$(id -u)" = 0 ]; then
    apt-get update -qq >/dev/null
    # shellcheck disable=SC2086  # a list of packages
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $packages >/dev/null
    has_what_it_takes "$@" && exit 0
fi
echo "Without $packages, $without. On Debian or Ubuntu: sudo apt-get install $packages" >&2
