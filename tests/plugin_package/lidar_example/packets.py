"""Packets of Acme: a datagram for each firing, its ranges in centimetres."""

import numpy as np

from lidarsim.plugins import Datagrams, PacketEncoder, Shots


class AcmeEncoder(PacketEncoder):
    """Sends each firing when it is over; 0 is no return."""

    columns = ()

    def encode(self, shots: Shots) -> list[Datagrams]:
        """Return the datagrams of the shots of a sweep."""
        units = np.nan_to_num(np.rint(100 * shots.range_m[0])).astype("<u2")
        payloads = units.view(np.uint8).reshape(len(shots), -1)
        due_ns = shots.starts_ns + self.firing_interval_ns
        return [Datagrams(payloads, due_ns, self.port("data", 4000))]

    def finish(self) -> list[Datagrams]:
        """Return no datagrams, as no shots are left."""
        return []
