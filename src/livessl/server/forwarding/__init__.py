"""The way of a site's results to a hub: an outbox in the history's database, and its link to NATS JetStream."""
