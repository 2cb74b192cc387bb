#!/bin/sh
# Mitsuba needs libatomic.so.1, which bare Debian machines lack: install it where we may, else say how.
set -eu
if ldconfig -p 2>/dev/null | grep -q 'libatomic\.so\.1' || /sbin/ldconfig -p 2>/dev/null | grep -q 'libatomic\.so\.1'; then
    exit 0
fi
if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; then
    echo "installing libatomic1, which Mitsuba needs"
    apt-get install -y -qq libatomic1 >/dev/null 2>&1 || { apt-get update -qq && apt-get install -y -qq libatomic1 >/dev/null; }
    exit 0
fi
echo "Mitsuba needs the system library libatomic1; install it and run make again:" >&2
echo "    sudo apt-get install libatomic1" >&2
exit 1
