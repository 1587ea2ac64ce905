"""What all tests start from."""

import signal

# A shell starts jobs in the background with interrupts ignored, and whatever they start inherits
# that: programs that tests interrupt would not notice.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Dask's own clusters look this long after each death whether the worker is there, and give it up
# when it is not: also one that has come back since and was killed again by the same test.
try:
    import dask
except ImportError:  # the kernels can be tested without it
    pass
else:
    dask.config.set({"distributed.deploy.lost-worker-timeout": "1h"})

# An example may take as long as a busy machine needs.
try:
    from hypothesis import HealthCheck, settings
except ImportError:
    pass
else:
    slow = [HealthCheck.too_slow]
    settings.register_profile("patient", deadline=None, suppress_health_check=slow)
    settings.load_profile("patient")
