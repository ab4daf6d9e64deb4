"""Charts: what each of them shows, as data (`rtid.tell.story`), and the pictures of flow maps."""
