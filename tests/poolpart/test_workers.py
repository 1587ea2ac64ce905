"""Asking for all workers while the client asks for none."""

from distributed import Client

from poolpart import Partition, Pool, worker_identities


def test_all_workers_are_there_though_the_clients_own_answer_has_none(client, monkeypatch):
    async def update(self, n_workers=0):
        # Its periodic question comes between another one and the look at the answer.
        self._scheduler_identity = await self.scheduler.identity(n_workers=0)

    monkeypatch.setattr(Client, "_update_scheduler_info", update)
    assert not client.scheduler_info(n_workers=-1)["workers"]
    names = ["A-0", "A-1", "B-0", "plain"]
    assert sorted(worker["name"] for worker in worker_identities(client).values()) == names
    assert sorted(Pool.from_client(client).names) == names
    assert (len(Partition("A", client)), Partition("A", client).slots) == (2, 4)
