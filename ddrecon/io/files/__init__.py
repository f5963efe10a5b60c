"""Files and folders of any kind: safe reading, atomic writing, locks, manifests."""
