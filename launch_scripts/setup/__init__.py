"""Set-up of everything that the entry points need, standard library only: python3 launch_scripts/setup."""


def ensure(argv=None):
    """entry.ensure(), where also a Ctrl-C while it is imported is one line."""
    _call("ensure", argv)


def launch(scenario):
    """entry.launch() in the same way."""
    return _call("launch", scenario)


def _call(name, argument):
    try:
        from setup import entry

        return getattr(entry, name)(argument)
    except KeyboardInterrupt:
        import sys

        print("interrupted", file=sys.stderr)
        raise SystemExit(130) from None
