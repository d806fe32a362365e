"""Which action does a certificate allow? The safety filter and its models of what follows."""
