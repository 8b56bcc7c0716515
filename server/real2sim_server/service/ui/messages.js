// Sentences for the person, shown for a while.
import { sentence } from "./api.js";
export function notify(text, kind = "") {
  const box = document.createElement("div");
  box.className = `message ${kind}`;
  box.textContent = sentence(text);
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
  setTimeout(() => box.remove(), kind === "bad" ? 9000 : 5000);
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
