"""Web server of the page: who may reach it, what browsers run, links, and text in markup."""
