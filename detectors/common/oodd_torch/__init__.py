"""What the recurrent reference detectors share: network, training, forecasting, the detector.

Importing this package imports torch; plug-in modules do so inside their factories only.
"""

from oodd_torch.detector import ForecastDetector
from oodd_torch.settings import Settings

__all__ = ["ForecastDetector", "Settings"]
