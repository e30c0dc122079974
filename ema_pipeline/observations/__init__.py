"""What was measured, as residuals with their derivatives: one file per kind of observation."""
