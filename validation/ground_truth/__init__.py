"""Study of the plugin against closed answers and a printed trace."""
