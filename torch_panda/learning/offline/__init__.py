"""Agents that learn offline: GCBC, GCIVL, GCIQL, HIQL, QRL and CRL."""

from torch_panda.learning.offline.base import OfflineAgent, OfflineHyperparameters
from torch_panda.learning.offline.crl import CRL
from torch_panda.learning.offline.gcbc import GCBC
from torch_panda.learning.offline.gciql import GCIQL
from torch_panda.learning.offline.gcivl import GCIVL
from torch_panda.learning.offline.hiql import HIQL
from torch_panda.learning.offline.qrl import QRL

OFFLINE_AGENTS: dict[str, type[OfflineAgent]] = {
    "gcbc": GCBC,
    "gcivl": GCIVL,
    "gciql": GCIQL,
    "hiql": HIQL,
    "qrl": QRL,
    "crl": CRL,
}

__all__ = ["OFFLINE_AGENTS", "OfflineAgent", "OfflineHyperparameters"]
