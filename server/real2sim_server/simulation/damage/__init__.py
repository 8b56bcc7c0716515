"""What crashes leave on vehicles: folded sheet, broken lamps and glass, fragments on the road.

Particles say how far each place was moved; this says what sheet, glass and plastic make of it. One
account for simulated rollouts, REST and the closed loop.
"""

from .appearance import DamagedVehicle
from .breakage import Breakage, BreakageLog
from .fragments import fragment_cloud
from .underside import with_underside

__all__ = ["Breakage", "BreakageLog", "DamagedVehicle", "fragment_cloud", "with_underside"]
