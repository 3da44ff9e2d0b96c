"""The report of a run: one self-contained page, figures for a README, and the summary as text."""

from rapid.evaluation.summary import summary_text as text_summary
from rapid.report.data import ReportData, RoutingSnapshot
from rapid.report.figures import write_figures
from rapid.report.page import write_report

__all__ = ["ReportData", "RoutingSnapshot", "text_summary", "write_figures", "write_report"]
