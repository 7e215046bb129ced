"""The networks to compare with, by name and by the preset whose input and output counts
they have."""

import flax.linen as nn

from experiments.baselines.fsc import FSC, FSC_SMALL, FSCConfig
from experiments.baselines.pcn import PCN, PCN_SMALL, PCNConfig
from experiments.baselines.pointr import POINTR_SMALL, PoinTr, PoinTrConfig
from experiments.baselines.seedformer import (
    SEEDFORMER_SMALL,
    SeedFormer,
    SeedFormerConfig,
)

NETWORKS: dict[str, dict[str, nn.Module]] = {
    "pcn": {"small": PCN(PCN_SMALL), "paper": PCN(PCNConfig())},
    "pointr": {"small": PoinTr(POINTR_SMALL), "paper": PoinTr(PoinTrConfig())},
    "seedformer": {
        "small": SeedFormer(SEEDFORMER_SMALL),
        "paper": SeedFormer(SeedFormerConfig()),
    },
    "fsc": {"small": FSC(FSC_SMALL), "paper": FSC(FSCConfig())},
}
