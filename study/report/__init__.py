"""The study's report: what it computes, its tables, figures and page."""
