"""`jaxbundle pushbroom …`: line scanners, a file for each command."""

from jaxbundle.cli.pushbroom import locate as locate
from jaxbundle.cli.pushbroom import project as project
