"""What all tests start from."""

import signal

# A shell starts jobs in the background with interrupts ignored, and whatever they start inherits
# that: programs that tests interrupt would not notice.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
