#!/bin/sh
# System libraries that bare Debian machines lack: install them where we may, else say how. Mitsuba needs
# libatomic.so.1 always; with the argument `meshes`, those of pymeshlab too; with `browser`, Chromium where it can be
# had, without which some tests are skipped.
set -eu

need() { # PACKAGE SONAME WHAT
    if { ldconfig -p 2>/dev/null || /sbin/ldconfig -p 2>/dev/null; } | grep -qF "$2"; then
        return
    fi
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; then
        echo "installing $1, which $3 needs"
        apt-get install -y -qq "$1" >/dev/null 2>&1 || { apt-get update -qq && apt-get install -y -qq "$1" >/dev/null; }
        return
    fi
    echo "$3 needs the system library $1; install it and run make again:" >&2
    echo "    sudo apt-get install $1" >&2
    exit 1
}

wish() { # PACKAGE COMMAND WHAT
    if command -v "$2" >/dev/null 2>&1; then
        return
    fi
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; then
        echo "installing $1, for $3"
        apt-get install -y -qq "$1" >/dev/null 2>&1 || { apt-get update -qq && apt-get install -y -qq "$1" >/dev/null; } && return
    fi
    echo "no $2: $3 are skipped; to have them: sudo apt-get install $1" >&2
}

need libatomic1 libatomic.so.1 Mitsuba
for part in "$@"; do
    case "$part" in
    meshes)
        need libgl1 libGL.so.1 pymeshlab
        need libopengl0 libOpenGL.so.0 pymeshlab
        ;;
    browser) wish chromium chromium "tests of the report's page in a browser" ;;
    esac
done
