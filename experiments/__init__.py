"""The studies: models, engines, controllers and bodies put together. One file a chapter, or one a task."""
