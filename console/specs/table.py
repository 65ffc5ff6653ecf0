"""Every subcommand, in the order of `armwright --help`."""

from console.specs.assessing import ASSESSING
from console.specs.bringup import BRINGUP
from console.specs.calibrating import CALIBRATING
from console.specs.cell import CELLS
from console.specs.end_effector import END_EFFECTOR
from console.specs.files import FILES
from console.specs.gap import GAP
from console.specs.operating import OPERATING
from console.specs.planning import PLANNING
from console.specs.recording import RECORDING
from console.specs.trying import TRYING
from console.specs.visualisation import VISUALISATION

COMMANDS = (
    *TRYING,
    *BRINGUP,
    *OPERATING,
    *CELLS,
    *END_EFFECTOR,
    *RECORDING,
    *CALIBRATING,
    *PLANNING,
    *ASSESSING,
    *GAP,
    *FILES,
    *VISUALISATION,
)
