"""The paper's questions of why pre-training helps (appendix "Extended Analysis"), each a function; see docs/analysis.md."""
