"""A run directory as one self-contained page.

==============  ==========================================================
page            gathers what the run left and fills the template
numbers         numbers as they are read
drawing         figures as PNG data, one style for all of them
corner          the samples of a posterior, pair by pair
template.html   the page
study           the page of a tolerance study, study.html
study_figures   its figures
style.css       how both look
==============  ==========================================================
"""

from __future__ import annotations

from pathlib import Path


def render_report(directory: Path) -> bytes:
    """Return the report of a run directory, whatever state the run ended in."""
    from holocal.app.report.page import page  # matplotlib takes half a second to import

    return page(directory).encode()


__all__ = ["render_report"]
