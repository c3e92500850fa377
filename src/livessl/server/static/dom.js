// Helpers for elements of the page. Text is only ever inserted as text, never as HTML.

/** The element with this id. */
export const find = (id) => document.getElementById(id);

/** A new element with its class, text, attributes (data-… and aria-… included) and children. */
export function el(tag, { className, text, ...attributes } = {}, ...children) {
  const element = document.createElement(tag);
  if (className) element.className = className;
  if (text !== undefined) element.textContent = text;
  for (const [name, value] of Object.entries(attributes)) {
    const absent = value === null || value === undefined || value === false;
    if (!absent) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** Set an element's text, but only if it differs, so that unchanged text costs the browser no layout. */
export function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
