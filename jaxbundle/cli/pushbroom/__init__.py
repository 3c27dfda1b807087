"""`jaxbundle pushbroom …`: line scanners, one file per command."""

from jaxbundle.cli.pushbroom import accuracy as accuracy
from jaxbundle.cli.pushbroom import correct as correct
from jaxbundle.cli.pushbroom import info as info
from jaxbundle.cli.pushbroom import locate as locate
from jaxbundle.cli.pushbroom import project as project
from jaxbundle.cli.pushbroom import refine as refine
from jaxbundle.cli.pushbroom import rpc as rpc
from jaxbundle.cli.pushbroom import simulate as simulate
from jaxbundle.cli.pushbroom import tie as tie
