"""Every subcommand, in the order of `armwright --help`."""

from console.specs.calibrating import CALIBRATING
from console.specs.files import FILES
from console.specs.operating import OPERATING
from console.specs.recording import RECORDING
from console.specs.trying import TRYING

COMMANDS = (*TRYING, *OPERATING, *RECORDING, *CALIBRATING, *FILES)
