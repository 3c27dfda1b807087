"""Reading and writing networks."""

from jaxbundle.io.formats import FORMATS as FORMATS
from jaxbundle.io.formats import Format as Format
from jaxbundle.io.formats import read_network as read_network
from jaxbundle.io.photo_list import read_photo_list as read_photo_list
from jaxbundle.io.project import read_project as read_project
from jaxbundle.io.project import write_project as write_project
