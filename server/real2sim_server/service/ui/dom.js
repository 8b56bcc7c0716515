// Creates elements from a short description.
export function el(tag, given = {}, ...children) {
  const node = document.createElement(tag);
  for (const [key, value] of Object.entries(given)) {
    if (key === "class") {
      node.className = value;
    } else if (key.startsWith("data-") || key.startsWith("aria-")) {
      node.setAttribute(key, value);
    } else {
      node[key] = value;
    }
  }
  node.append(...children.filter((c) => c !== null));
  return node;
}
export const row = (label, inputs) =>
  el("div", { class: "row" }, el("label", { textContent: label }), ...inputs);

// A number field. `change` gets the number, or null if the field is empty. Unfinished input is
// marked, so that it is not overwritten.
export function number(id, value, change, { min, max, placeholder = "", class: kind = "" } = {}) {
  const input = el("input", {
    id,
    type: "number",
    step: "any",
    placeholder,
    class: kind,
    value: tidy(value),
  });
  if (min !== undefined) {
    input.min = min;
    input.max = max;
  }
  input.setAttribute("aria-label", id);
  input.oninput = () => (input.dataset.typing = "yes");
  input.onchange = () => {
    delete input.dataset.typing;
    change(input.value === "" ? null : Number(input.value));
  };
  return input;
}
export const tidy = (v, digits = 3) =>
  v === null || v === undefined ? "" : String(Math.round(v * 10 ** digits) / 10 ** digits);
