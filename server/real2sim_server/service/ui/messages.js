// Messages that disappear after a while.
import { sentence } from "./api.js";
// An action is a button in the message; the message disappears when it is pressed.
export function notify(text, kind = "", action = null) {
  const box = document.createElement("div");
  box.className = `message ${kind}`;
  box.textContent = sentence(text);
  if (action) {
    const button = document.createElement("button");
    button.textContent = action.label;
    button.onclick = () => {
      box.remove();
      action.act();
    };
    box.append(button);
  }
  const list = document.getElementById("messages");
  for (const other of [...list.children]) {
    if (other.textContent === box.textContent) {
      other.remove();
    }
  }
  list.append(box);
  while (list.children.length > 3) {
    list.firstChild.remove();
  }
  setTimeout(() => box.remove(), action?.after ?? (kind === "bad" ? 9000 : 5000));
}
export const attempt =
  (fn) =>
  async (...given) => {
    try {
      return await fn(...given);
    } catch (error) {
      notify(error.message, "bad");
      return null;
    }
  };
