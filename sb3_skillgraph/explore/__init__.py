"""Looking at an agent: a page to click on, files for other programs, videos."""
