// The help about wrong maps, a dialog that a button opens.

export function startHelp() {
  const dialog = document.getElementById("help");
  document.getElementById("help-open").addEventListener("click", () => dialog.showModal());
  // A click on the backdrop has the dialog itself as target.
  dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
}
