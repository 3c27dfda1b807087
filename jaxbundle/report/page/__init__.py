"""The result of a command as one page of HTML, for a browser and for paper.

    pieces = jaxbundle.report.page.compose(adjustment)
    Path("report.html").write_text("".join(pieces))

An adjustment has its page here, and so has a refinement of scanner images (`refinement`);
calibrations, reconstructions and batches declare theirs in their subpackages.
"""

from jaxbundle.report.page.adjustment import Addition as Addition
from jaxbundle.report.page.adjustment import compose as compose
from jaxbundle.report.page.adjustment import compose_failure as compose_failure
from jaxbundle.report.page.document import Listing as Listing
from jaxbundle.report.page.document import Page as Page
from jaxbundle.report.page.document import Section as Section
from jaxbundle.report.page.document import write as write
from jaxbundle.report.page.origin import UNKNOWN as UNKNOWN
from jaxbundle.report.page.origin import InputFile as InputFile
from jaxbundle.report.page.origin import Origin as Origin
from jaxbundle.report.page.origin import fingerprint_files as fingerprint_files
from jaxbundle.report.page.origin import head_line as head_line
from jaxbundle.report.page.origin import stamp as stamp
from jaxbundle.report.page.overview import give_verdict as give_verdict
from jaxbundle.report.verdict import Finding as Finding
