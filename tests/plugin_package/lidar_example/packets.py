"""Acme packets: one datagram per firing, with the ranges in centimeters."""

import numpy as np

from lidarsim.plugins import Datagrams, PacketEncoder, Shots


class AcmeEncoder(PacketEncoder):
    """Encode each firing as one datagram, due at the end of the firing; 0 means no return."""

    columns = ()

    def encode(self, shots: Shots) -> list[Datagrams]:
        """Return the datagrams for the shots in a sweep."""
        units = np.nan_to_num(np.rint(100 * shots.range_m[0])).astype("<u2")
        payloads = units.view(np.uint8).reshape(len(shots), -1)
        due_ns = shots.starts_ns + self.firing_interval_ns
        return [Datagrams(payloads, due_ns, self.port("data", 4000))]

    def finish(self) -> list[Datagrams]:
        """Return no datagrams, because no shots are left over."""
        return []
