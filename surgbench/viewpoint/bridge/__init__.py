"""Controllers of other processes and languages: JSON lines over a local socket (``docs/viewpoint-bridge.md``)."""
