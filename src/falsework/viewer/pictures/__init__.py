"""Pictures, contact sheets and videos without a screen."""
