"""Compare images and folders of images: verdict, reports, self-test."""
