"""The command line, a file for each command.

Exit status: 0 solved; 2 bad input (one line, nothing written); 3 not solved (says why).
"""

from jaxbundle.cli import adjust as adjust
from jaxbundle.cli import batch as batch
from jaxbundle.cli import calibrate as calibrate
from jaxbundle.cli import camera as camera
from jaxbundle.cli import compare as compare
from jaxbundle.cli import convert as convert
from jaxbundle.cli import orient as orient
from jaxbundle.cli import plan as plan
from jaxbundle.cli import pushbroom as pushbroom
from jaxbundle.cli.app import main as main
