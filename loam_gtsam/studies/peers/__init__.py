"""Peers: other registration systems, run through their own Python packages, all of them optional.

Every peer runs with its own defaults unless a setting says otherwise. Its docstring says what is
not a default, and which moment of the sweep its pose belongs to.
"""

from __future__ import annotations

from urllib.parse import parse_qsl

from loam_gtsam.errors import nearest
from loam_gtsam.studies.peers.base import Inertial as Inertial
from loam_gtsam.studies.peers.base import Peer as Peer
from loam_gtsam.studies.peers.base import PeerError as PeerError
from loam_gtsam.studies.peers.base import TimedPoints as TimedPoints
from loam_gtsam.studies.peers.icp import GenzIcp, KissIcp, SmallGicp
from loam_gtsam.studies.peers.inertial import GenzLio, RkoLio
from loam_gtsam.studies.peers.process import PeerProcess

PEERS: dict[str, type[Peer]] = {
    peer.name: peer for peer in (KissIcp, GenzIcp, SmallGicp, RkoLio, GenzLio)
}
"""Every peer by its name on the command line."""


def make_peer(text: str, imu: Inertial | None = None) -> Peer:
    """The peer ``NAME``, or ``NAME?SETTING=VALUE&...`` with other settings than its defaults.

    Raises PeerError if no peer has this name or setting, or the peer is not installed. A peer whose
    instances disturb each other gets a process of its own.
    """
    name, _, query = text.partition("?")
    if name not in PEERS:
        raise PeerError(f"unknown peer {name!r}{nearest(name, PEERS)}")
    try:
        settings = dict(parse_qsl(query, strict_parsing=bool(query)))
    except ValueError as error:
        raise PeerError(f"{text}: expected {name}?SETTING=VALUE&...: {error}") from error
    kind = PEERS[name]
    return kind(settings, imu) if kind.shares else PeerProcess(kind, settings, imu)
