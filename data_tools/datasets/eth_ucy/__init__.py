"""The ETH walking pedestrians: trajectories seen from above, without detections."""

from data_tools.datasets.eth_ucy.dataset import FRAME_RATES, EthUcy

__all__ = ["FRAME_RATES", "EthUcy"]
