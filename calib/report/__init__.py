"""Reports and pictures: one page of HTML without any outside resource."""
